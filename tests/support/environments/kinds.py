"""Environments of each kind of match."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from evaluation.matches.game_loop import play_matches
from evaluation.matches.seating import Roster
from evaluation.schedules.builders import round_robin
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.environments.implementation import stock_stepping
from league.interface import Interface
from league.policies.onnx import OnnxPolicy
from league.policies.scripted import script
from league.results.records import Match, Schedule
from tests.support.leagues import tictactoe

ADVERSARY = {"adversary": ["adversary_*"], "good": ["agent_*"]}

TEAM = {"team": ["*"]}

EACH = {"first": ["agent_0"], "second": ["agent_1"]}

SIMULTANEOUS = "tests.support.environments.simultaneous:"


@dataclass(frozen=True)
class Kind:
    entry_point: str
    kwargs: dict[str, Any]
    sides: dict[str, list[str]] | None
    policies: dict[str, list[str]] | None = None
    memory: bool = False

    @cached_property
    def config(self) -> LeagueConfig:
        environment = {"entry_point": self.entry_point, "kwargs": self.kwargs}
        # A game is then a function of its policies and its seed, which the tests compare.
        play = {"actions": "greedy"}
        document = {"league": "kind", "environment": environment, "sides": self.sides, "play": play}
        return LeagueConfig.from_mapping(document | {"policies": self.policies})

    @cached_property
    def interface(self) -> Interface:
        return interface(self.config)

    @cached_property
    def roster(self) -> Roster:
        """kind@1 and kind@2 have different graphs, kind@3 has the graph of kind@1; two scripts are random."""
        spaces = {policy: self.interface.of_policy(policy) for policy in self.interface.policy_ids}
        roster = {}
        for ref, seed in {"kind@1": 1, "kind@2": 2, "kind@3": 1}.items():
            policies = {name: OnnxPolicy(tictactoe.linear(space, seed, self.memory)) for name, space in spaces.items()}
            roster[ref] = {agent: (name, policies[name]) for agent, name in self.interface.policies.items()}
        for ref in ("script:random", "script:again"):
            scripts = {name: script("random", space.observation, space.action) for name, space in spaces.items()}
            roster[ref] = {agent: (name, scripts[name]) for agent, name in self.interface.policies.items()}
        return roster

    def schedule(self, contestants: Sequence[str], blocks: int = 3, plies: int = 2) -> Schedule:
        config = self.config.model_copy(update={"play": self.config.play.model_copy(update={"opening_plies": plies})})
        return round_robin(config, self.interface, contestants, blocks)

    def play(self, schedule: Schedule, num_envs: int = 5, max_moves: int = 10_000) -> list[Match]:
        environment = stock_stepping(self.config.environment, num_envs)
        return play_matches(schedule, range(schedule.length), environment, self.interface, self.roster, max_moves)


KINDS = {
    "team": Kind("mpe2.simple_spread_v3", {"max_cycles": 6}, TEAM),
    "free for all": Kind("mpe2.simple_spread_v3", {"max_cycles": 6}, None),
    "continuous team": Kind("mpe2.simple_spread_v3", {"max_cycles": 6, "continuous_actions": True}, TEAM),
    "roles": Kind("mpe2.simple_adversary_v3", {"max_cycles": 6}, ADVERSARY, ADVERSARY),
    "roles, free for all": Kind("mpe2.simple_adversary_v3", {"max_cycles": 6}, None, ADVERSARY),
    "one agent": Kind("mpe2.simple_v3", {"max_cycles": 6}, None),
    "memory": Kind("mpe2.simple_spread_v3", {"max_cycles": 6}, None, memory=True),
    "two, with a memory": Kind("mpe2.simple_push_v3", {"max_cycles": 6}, None, ADVERSARY, memory=True),
    "early and late": Kind(SIMULTANEOUS + "meeting", {"arrives": [0, 2], "leaves": [3, 7]}, None, EACH, memory=True),
    "RLlib's API": Kind(SIMULTANEOUS + "rllib_meeting", {"ends": 5}, None, memory=True),
}
