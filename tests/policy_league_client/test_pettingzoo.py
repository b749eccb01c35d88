"""PettingZoo environments played through a real server give the same results as with local policies."""

from collections.abc import Iterator
from copy import deepcopy
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete
from pettingzoo import ParallelEnv
from pettingzoo.classic import rps_v2, tictactoe_v3

from league.errors import InvalidInput, UnknownLeague
from league.policies.onnx import OnnxPolicy
from league.policies.policy import Policy
from league.registry.registry import Registry
from league.settings import Storage
from policy_league_client import Client
from policy_league_client.pettingzoo import Step, play
from tests.support.leagues import tictactoe
from tests.support.leagues.protocol_leagues import CHOICE, table
from tests.support.leagues.served_leagues import everything, promote, publish, register
from tests.support.policies.graphs import masked_mlp
from tests.support.servers.streaming import Listening, listening
from tests.support.waiting import until

BOTH = {"player_1": "tictactoe", "player_2": "tictactoe@2"}


@pytest.fixture(scope="module")
def registry(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Registry]:
    home = tmp_path_factory.mktemp("played")
    everything(Storage.at(home)).close()
    registry = tictactoe.registry(home)
    for seed in range(2):
        tictactoe.publish(registry, masked_mlp((3, 3, 2), 9, seed=seed))
    register(registry, "rps", {"shared": CHOICE})
    publish(registry, "rps", {"shared": table()}, "run")
    for league in ("tictactoe", "rps"):
        promote(registry, league, 1)
    yield registry
    registry.close()


@pytest.fixture(scope="module")
def listener(registry: Registry) -> Iterator[Listening]:
    with listening(registry.storage) as listener:
        yield listener


@pytest.fixture
def client(listener: Listening) -> Iterator[Client]:
    with Client(listener.url) as client:
        yield client


def play_locally(policies: dict[str, Policy]) -> list[tuple[str, int]]:
    """Tic-tac-toe in PettingZoo's agent_iter loop."""
    environment, moves = tictactoe_v3.env(), []
    environment.reset(seed=3)
    for agent in environment.agent_iter():
        observation, _, terminated, truncated, _ = environment.last()
        action = None
        if not (terminated or truncated):
            batch = {name: array[None].astype(np.int8) for name, array in observation.items()}
            action = int(policies[agent].act(batch).actions[0])
            moves.append((agent, action))
        environment.step(action)
    return moves


def test_an_aec_environment_is_played_to_the_end(client: Client) -> None:
    policies = {f"player_{1 + seed}": OnnxPolicy(masked_mlp((3, 3, 2), 9, seed=seed)) for seed in range(2)}
    steps = list(play(tictactoe_v3.env(), client, BOTH, seed=3))
    moves = play_locally(policies)
    by_agent = {agent: [step for step in steps if step.agent == agent] for agent in policies}
    for agent, turns in by_agent.items():
        assert [step.action for step in turns] == [action for mover, action in moves if mover == agent]
        assert [step.terminated for step in turns] == [False] * (len(turns) - 1) + [True]
        for step, following in pairwise(turns):
            np.testing.assert_array_equal(step.next_observation["observation"], following.observation["observation"])
        assert {step.response.version for step in turns if step.response} == {1 if agent == "player_1" else 2}
    assert sum(step.reward for step in steps) == 0
    assert {step.observation["action_mask"][step.action] for step in steps} == {1}


def test_a_function_can_play_against_a_model(client: Client) -> None:
    def first_legal(observation: Any) -> int:
        return int(np.flatnonzero(observation["action_mask"])[0])

    steps = list(play(tictactoe_v3.env(), client, BOTH | {"player_2": first_legal}, seed=3, probabilities=True))
    for step in steps:
        assert (step.response is None) == (step.agent == "player_2")
        assert step.response is None or step.response.probabilities.argmax() == step.action


def summary(steps: list[Step]) -> list[tuple[str, int, float]]:
    return [(step.agent, step.action, step.reward) for step in steps]


def test_a_parallel_environment_is_played_step_by_step(client: Client) -> None:
    environment = rps_v2.parallel_env(max_cycles=12)
    players = {"player_0": "rps", "player_1": "rps@1"}
    games = [list(play(environment, client, players, seed=seed, explore=True)) for seed in (5, 5, 6)]
    assert summary(games[0]) == summary(games[1]) != summary(games[2])
    for steps in games:
        assert len(steps) == 2 * 12
        for one, other in zip(steps[::2], steps[1::2], strict=True):
            assert (one.agent, other.agent) == ("player_0", "player_1")
            assert one.reward == -other.reward == [0, 1, -1][(one.action - other.action) % 3]
            assert int(one.next_observation) == other.action
        assert [step.truncated for step in steps] == [False] * 22 + [True] * 2


class Constant(ParallelEnv):
    """Two agents with constant observations in a reused array; the second agent leaves early."""

    metadata: dict[str, Any] = {"name": "counters"}  # noqa: RUF012
    possible_agents = ["first", "second"]  # noqa: RUF012
    lengths = {"first": 5, "second": 3}  # noqa: RUF012

    def __init__(self) -> None:
        self._observation = np.zeros(1, np.float32)

    def observation_space(self, agent: str) -> Box:
        return Box(-np.inf, np.inf, (1,), np.float32)

    def action_space(self, agent: str) -> Discrete:
        return Discrete(2)

    def reset(self, seed: int | None = None, options: dict | None = None) -> Any:
        self.agents, self._time = list(self.possible_agents), 0
        self._observation[:] = 1
        return dict.fromkeys(self.agents, self._observation), {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, int]) -> Any:
        self._time += 1
        acted = list(self.agents)
        self._observation[:] = 1 if self._time < 5 else 7
        over = {agent: self._time == self.lengths[agent] for agent in acted}
        self.agents = [agent for agent in acted if not over[agent]]
        rewards = {agent: float(actions[agent]) for agent in acted}
        observations, terminated = dict.fromkeys(acted, self._observation), dict.fromkeys(acted, False)
        return observations, rewards, terminated, over, {agent: {} for agent in acted}


def test_each_agent_has_its_own_recurrent_state(client: Client) -> None:
    environment = Constant()
    for _ in range(2):
        steps = list(play(environment, client, {"first": "memory", "second": "memory"}))
        by_agent = {agent: [step for step in steps if step.agent == agent] for agent in environment.possible_agents}
        assert [step.action for step in by_agent["first"]] == [0, 0, 1, 1, 1]
        assert [step.action for step in by_agent["second"]] == [0, 0, 1]
        assert [step.truncated for step in by_agent["second"]] == [False, False, True]
        assert [step.observation[0] for step in by_agent["first"]] == [1] * 5, "copied from the reused array"
        assert by_agent["first"][-1].next_observation[0] == 7
        assert [step.reward for step in by_agent["first"]] == [0, 0, 1, 1, 1]


def test_a_promotion_during_an_episode_changes_no_player(client: Client, registry: Registry) -> None:
    game = play(tictactoe_v3.env(), client, {"player_1": "tictactoe", "player_2": "tictactoe"}, seed=3)
    first = deepcopy(next(game))
    try:
        promote(registry, "tictactoe", 2)
        until(lambda: client.act("tictactoe", first.observation).version == 2)
        assert {step.response.version for step in (first, *game) if step.response} == {1}
    finally:
        promote(registry, "tictactoe", 1)
        registry.changes.wait_for_alias(registry.aliases.history("tictactoe")[0], 240)


def test_each_agent_needs_a_player(client: Client) -> None:
    with pytest.raises(InvalidInput, match="no player for player_2"):
        play(tictactoe_v3.env(), client, {"player_1": "tictactoe"})
    with pytest.raises(UnknownLeague):
        next(play(rps_v2.parallel_env(), client, {"player_0": "rps", "player_1": "nobody"}))
