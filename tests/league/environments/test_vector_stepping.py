"""A vectorised environment gives the turns of the stock environment: rows, order and dtypes."""

from collections.abc import Iterable
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from league.config.environment import EnvironmentConfig
from league.environments.implementation import implementation, stepping, stock_stepping
from league.environments.stepping import Batch, Turn
from league.environments.vector.vector_env import AgentRows
from league.errors import EnvironmentMismatch, IllegalAction, InvalidReward
from tests.conformance.stepping import states_of
from tests.support.environments import vector_copies
from tests.support.environments.episodes import episodes
from tests.support.environments.player import Player

COPIES = vector_copies.__name__


def copied(name: str, **kwargs: Any) -> EnvironmentConfig:
    """A stock environment with VectorCopies of it."""
    cls = getattr(vector_copies, name)
    return EnvironmentConfig(entry_point=cls.entry_point, kwargs=kwargs, vector=f"{COPIES}:{name}")


ENVIRONMENTS = {
    "connect four": EnvironmentConfig(entry_point="pettingzoo.classic.connect_four_v3"),
    "tic-tac-toe": EnvironmentConfig(entry_point="pettingzoo.classic.tictactoe_v3"),
    "Leduc hold'em": EnvironmentConfig(entry_point="pettingzoo.classic.leduc_holdem_v4"),
    "rock, paper, scissors": EnvironmentConfig(entry_point="pettingzoo.classic.rps_v2", kwargs={"max_cycles": 4}),
    "spread": EnvironmentConfig(entry_point="mpe2.simple_spread_v3", kwargs={"max_cycles": 5}),
    "two kinds of agents": EnvironmentConfig(entry_point="mpe2.simple_adversary_v3", kwargs={"max_cycles": 5}),
    "joining and leaving": copied("VectorMeeting", arrives=[0, 2, 1, 0], leaves=[4, 5, 2, 3], truncated=[1, 2]),
    "turns, early deaths": copied("VectorCounting", lives=[1, 4, 2, 4], truncated=[1, 2]),
}


def assert_same_rows(vector: AgentRows | Batch, expected: AgentRows | Batch) -> None:
    for field in fields(expected):
        actual, other = getattr(vector, field.name), getattr(expected, field.name)
        columns = ((actual[name], other[name]) for name in other) if isinstance(other, dict) else [(actual, other)]
        for ours, column in columns:
            assert ours.dtype == column.dtype, field.name
            assert ours.tobytes() == column.tobytes(), field.name
            assert ours.shape == column.shape


def assert_same_turn(vector: Turn, expected: Turn) -> None:
    assert list(vector.batches) == list(expected.batches)
    for group, batch in expected.batches.items():
        assert_same_rows(vector.batches[group], batch)
    assert len(vector.endings) == len(expected.endings)
    for actual, other in zip(vector.endings, expected.endings, strict=True):
        assert_same_rows(actual, other)
    np.testing.assert_array_equal(vector.finished, expected.finished)
    np.testing.assert_array_equal(vector.crashed, expected.crashed)
    np.testing.assert_equal(states_of(vector.states), states_of(expected.states))
    np.testing.assert_equal(states_of(vector.last_states), states_of(expected.last_states))


@pytest.mark.parametrize("name", ENVIRONMENTS)
@settings(max_examples=5, deadline=None)
@given(seed=st.integers(0, 2**32), num_envs=st.integers(1, 6))
def test_turns_equal_those_of_lockstep(name: str, seed: int, num_envs: int) -> None:
    config = ENVIRONMENTS[name]
    assert implementation(config).vector is not None
    vector = Player(stepping(config, num_envs, crashes=3, states=True), seed)
    expected = Player(stock_stepping(config, num_envs, crashes=3, states=True), seed)
    assert_same_turn(vector.start(), expected.start())
    for _ in range(30):
        assert_same_turn(vector.step(), expected.step())
        if not expected.turn.batches:
            break


def zeros(turn: Turn) -> dict[int, NDArray]:
    return {group: np.zeros(len(batch), np.int64) for group, batch in turn.batches.items()}


def test_time_is_shared_by_the_environments_of_a_call(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a clock that advances by one second at each reading."""
    clock = iter(np.arange(100.0))
    env, turn = started(copied("VectorMeeting"), range(3), 4)
    monkeypatch.setattr("league.environments.copies.perf_counter", lambda: next(clock))
    before = env.seconds()
    env.step(zeros(turn))
    assert (env.seconds() - before).tolist() == pytest.approx([1 / 3, 1 / 3, 1 / 3, 0.0])
    assert env.busy.tolist() == []


def started(config: EnvironmentConfig, seeds: Iterable[int], num_envs: int, **options: Any) -> Any:
    env = stepping(config, num_envs, **options)
    return env, env.start(episodes(seeds, range(len(env.agents))))


def test_faults_are_named() -> None:
    env, turn = started(copied("Faulty"), range(50), 4)
    for _ in range(2):
        turn = env.step(zeros(turn))
    with pytest.raises(ArithmeticError, match="the array is on fire") as raised:
        env.step(zeros(turn))
    assert raised.value.__notes__ == ["in one of 4 episodes, with the seeds 0, 1, 2, 3"]
    assert env.busy.tolist() == [0, 1, 2, 3]
    with pytest.raises(EnvironmentMismatch, match="a vectorised environment cannot be rendered"):
        env.render(0)
    env, turn = started(copied("VectorMeeting", bad_reward=float("nan")), [12, 13], 2, crashes=3)
    with pytest.raises(InvalidReward, match="agent_0 got a reward of nan in the episode with seed 12"):
        env.step(zeros(turn))
    env, turn = started(copied("VectorMeeting"), [0, 1], 2)
    with pytest.raises(IllegalAction, match="action 3 of agent_1"):
        env.step(zeros(turn) | {1: np.array([0, 3])})
    assert set(env.step(zeros(turn)).batches) == {0, 1}
