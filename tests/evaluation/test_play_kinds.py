"""Matches of every kind of environment: simultaneous ones, with any number of sides, continuous, with a memory."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import pytest

from evaluation.exhibition import exhibit
from evaluation.match import plan
from evaluation.play import Roster, play
from evaluation.replay import replay
from evaluation.schedule import round_robin
from league.config import LeagueConfig
from league.environments.building import interface
from league.environments.lockstep import stepping
from league.errors import GameHung
from league.interface import Interface
from league.policies.onnx import OnnxPolicy
from league.policies.scripted import script
from league.results.admission import admit
from league.results.documents import dump_games, load_games
from league.results.records import Match, Schedule, Scoring
from tests.evaluation import examples

ADVERSARY = {"adversary": ["adversary_*"], "good": ["agent_*"]}
TEAM = {"team": ["*"]}
EACH = {"first": ["agent_0"], "second": ["agent_1"]}
MEETINGS = "tests.league.environments.simultaneous:"


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
        document: dict[str, Any] = {"league": "kind", "environment": environment, "sides": self.sides}
        if self.policies:
            document["policies"] = self.policies
        return LeagueConfig.from_mapping(document)

    @cached_property
    def interface(self) -> Interface:
        return interface(self.config)

    @cached_property
    def roster(self) -> Roster:
        """kind@1 and kind@2 are different graphs, kind@3 is kind@1 once more; two scripts are random."""
        spaces = {policy: self.interface.of_policy(policy) for policy in self.interface.policy_ids}
        roster = {}
        for ref, seed in {"kind@1": 1, "kind@2": 2, "kind@3": 1}.items():
            own = {name: OnnxPolicy(examples.linear(space, seed, self.memory)) for name, space in spaces.items()}
            roster[ref] = {agent: (name, own[name]) for agent, name in self.interface.policies.items()}
        for ref in ("script:random", "script:again"):
            dice = {name: script("random", space.observation, space.action) for name, space in spaces.items()}
            roster[ref] = {agent: (name, dice[name]) for agent, name in self.interface.policies.items()}
        return roster

    def schedule(self, contestants: Sequence[str], blocks: int = 3, plies: int = 2) -> Schedule:
        config = self.config.model_copy(update={"play": self.config.play.model_copy(update={"opening_plies": plies})})
        return round_robin(config, self.interface, contestants, blocks)

    def played(self, schedule: Schedule, copies: int = 5, max_moves: int = 10_000) -> list[Match]:
        environment = stepping(self.config.environment, copies)
        return play(schedule, range(schedule.length), environment, self.interface, self.roster, max_moves)


KINDS = {
    "team": Kind("mpe2.simple_spread_v3", {"max_cycles": 6}, TEAM),
    "free for all": Kind("mpe2.simple_spread_v3", {"max_cycles": 6}, None),
    "continuous team": Kind("mpe2.simple_spread_v3", {"max_cycles": 6, "continuous_actions": True}, TEAM),
    "roles": Kind("mpe2.simple_adversary_v3", {"max_cycles": 6}, ADVERSARY, ADVERSARY),
    "roles, free for all": Kind("mpe2.simple_adversary_v3", {"max_cycles": 6}, None, ADVERSARY),
    "one agent": Kind("mpe2.simple_v3", {"max_cycles": 6}, None),
    "memory": Kind("mpe2.simple_spread_v3", {"max_cycles": 6}, None, memory=True),
    "two, with a memory": Kind("mpe2.simple_push_v3", {"max_cycles": 6}, None, ADVERSARY, memory=True),
    "early and late": Kind(MEETINGS + "meeting", {"arrives": [0, 2], "leaves": [3, 7]}, None, EACH, memory=True),
    "RLlib's API": Kind(MEETINGS + "rllib_meeting", {"ends": 5}, None, memory=True),
}
kinds = pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
CONTESTANTS = ["kind@1", "kind@2", "script:random"]


@kinds
def test_games_do_not_depend_on_how_many_are_played_together(kind: Kind) -> None:
    schedule = kind.schedule(CONTESTANTS)
    alone = kind.played(schedule, copies=1)
    assert [match.position for match in alone] == list(range(9))
    for copies in (4, 32):
        assert kind.played(schedule, copies) == alone


@kinds
def test_recorded_games_are_admitted_kept_and_replayed_exactly(kind: Kind) -> None:
    schedule = kind.schedule(CONTESTANTS)
    environment = stepping(kind.config.environment, 1)
    for match in kind.played(schedule):
        admit(match, schedule)
        kept = replace(match, games=load_games(dump_games(match.games)))
        assert kept == match
        for index, game in enumerate(kept.games):
            moments = list(replay(environment, kind.config, kind.interface, kept, index))
            assert [move.action for moment in moments for move in moment.moves] == [*game.opening, *game.actions]


@kinds
def test_a_match_is_the_game_that_is_shown(kind: Kind) -> None:
    """The exhibition asks each agent's policy alone, and carries its memory itself."""
    schedule = kind.schedule(["kind@1", "kind@2"], plies=0)
    environment = stepping(kind.config.environment, 1)
    side = {agent: i for i, agents in enumerate(kind.interface.sides.values()) for agent in agents}
    for match in kind.played(schedule):
        for game, seating in zip(match.games, plan(schedule, match.position), strict=True):
            seats = {agent: match.contestants[seating.sides[side[agent]]] for agent in kind.interface.agents}
            players = {agent: kind.roster[ref][agent][1] for agent, ref in seats.items()}
            moments = list(exhibit(environment, players, game.seed))
            assert tuple(move.action for moment in moments for move in moment.moves) == game.actions


@kinds
def test_one_policy_under_two_names_is_even_in_every_block(kind: Kind) -> None:
    for match in kind.played(kind.schedule(["kind@1", "kind@3"], blocks=6)):
        assert match.score(0) == match.score(1) == 0.5
        assert match.mean_return(0) == pytest.approx(match.mean_return(1), abs=1e-12)


@kinds
def test_contestants_that_change_places_change_results(kind: Kind) -> None:
    there, back = (kind.schedule(pair, blocks=6) for pair in (["kind@1", "kind@2"], ["kind@2", "kind@1"]))
    back = replace(back, id=there.id, seed=there.seed)
    scores = [match.score(0) for match in kind.played(there)]
    assert [match.score(1) for match in kind.played(back)] == scores


@pytest.mark.parametrize("scoring", ["game", "side"])
def test_chance_is_even_however_unequal_the_seats(scoring: Scoring) -> None:
    """Four seats, three hunters and the hunted: who sits where decides a game, and nothing in the mean of blocks."""
    roles = {"hunters": ["adversary_*"], "hunted": ["agent_*"]}
    kind = Kind("mpe2.simple_tag_v3", {}, None, roles)
    schedule = replace(kind.schedule(["script:random", "script:again"], blocks=160, plies=0), scoring=scoring)
    matches = kind.played(schedule, copies=16)
    scores = np.array([match.score(0) for match in matches])
    assert abs(scores.mean() - 0.5) < 4 * scores.std() / np.sqrt(len(scores))
    by_seat = [np.mean([match.games[0].scores[0] for match in matches[seat::4]]) for seat in range(4)]
    if scoring == "game":
        assert max(by_seat) - min(by_seat) > 0.2
        assert {tuple(sorted(set(game.sides))) for match in matches for game in match.games} == {(0, 1)}


def test_each_plays_alone_where_there_is_one_side() -> None:
    kind = KINDS["team"]
    for match in kind.played(kind.schedule(["kind@1", "kind@2"])):
        first, second = match.games
        assert (first.sides, second.sides) == ((0,), (1,))
        assert first.returns[1] is second.returns[0] is None
        assert first.opening == second.opening
        assert first.actions != second.actions


def test_an_opening_is_random_steps_of_all_agents() -> None:
    kind = KINDS["free for all"]
    matches = kind.played(kind.schedule(["kind@1", "kind@2"], blocks=6, plies=2))
    assert {len(game.opening) for match in matches for game in match.games} == {2 * 3}
    assert {len(game.actions) for match in matches for game in match.games} == {4 * 3}
    openings = [{game.opening for game in match.games} for match in matches]
    assert all(len(opening) == 1 for opening in openings)
    assert len(set.union(*openings)) == len(matches)


def test_a_step_of_many_agents_is_one_move() -> None:
    kind = KINDS["free for all"]
    schedule = kind.schedule(["kind@1", "kind@2"])
    assert kind.played(schedule, max_moves=6)
    with pytest.raises(GameHung, match="after 5 moves"):
        kind.played(schedule, max_moves=5)
