"""The vectorised MPE environments: reports equal those of stock, which arguments are implemented, and the rules."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from league.config.environment import EnvironmentConfig
from league.environments.vector.equality import DifferentialTest, compare
from league.environments.vector.mpe.initial_states import goals_and_positions, positions_only
from league.environments.vector.mpe.particle_env import ParticleEnv
from league.environments.vector.mpe.particles import lengths
from league.environments.vector.mpe.simple_adversary import SimpleAdversary
from league.environments.vector.mpe.simple_reference import SimpleReference
from league.environments.vector.mpe.simple_spread import SIZE, SimpleSpread
from league.environments.vector.mpe.simple_tag import SimpleTag, bound_penalties
from league.environments.vector.vector_env import AgentRows, UnsupportedArguments
from league.random import pcg64
from tests.support.environments.plans import Plan, assert_equal, plans


def config(name: str, **kwargs: Any) -> EnvironmentConfig:
    return EnvironmentConfig(entry_point=f"mpe2.{name}", kwargs=kwargs)


AGENT_STEPS = 100_000


COMMON = {"max_cycles": st.integers(1, 12), "continuous_actions": st.booleans()}


RATIO = {"local_ratio": st.sampled_from([0, 0.25, 0.5, 0.9, 1])}


TAG = {"num_good": st.integers(1, 2), "num_adversaries": st.integers(1, 3), "num_obstacles": st.integers(0, 2)}


CASES: dict[str, tuple[Callable[..., ParticleEnv], dict[str, st.SearchStrategy[Any]]]] = {
    "simple_spread_v3": (SimpleSpread, {"N": st.integers(1, 4), **RATIO, **COMMON, "max_cycles": st.integers(0, 12)}),
    "simple_adversary_v3": (SimpleAdversary, {"N": st.integers(1, 4), **COMMON}),
    "simple_tag_v3": (SimpleTag, {**TAG, **COMMON}),
    "simple_reference_v3": (SimpleReference, {**RATIO, **COMMON}),
}
"""Environments, with strategies of the arguments that they implement."""


OPTIONS = {"benchmark_data": True, "curriculum": True, "terminate_on_success": True, "num_agent_neighbors": 1}


NOT_IMPLEMENTED: dict[type[ParticleEnv], list[dict[str, Any]]] = {
    SimpleSpread: [
        *({name: value} for name, value in OPTIONS.items()),
        *({"N": number} for number in (0, 2.0)),
        *({"local_ratio": ratio} for ratio in (1.5, None)),
        {"dynamic_rescaling": False},
        {"num_landmark_neighbors": 1},
        {"render_mode": "rgb_array"},
        {"unknown": 1},
    ],
    SimpleAdversary: [
        {"N": 0},
        {"num_agent_neighbors": 1},
        {"benchmark_data": True},
        {"local_ratio": 0.5},
        {"curriculum": False},
    ],
    SimpleTag: [
        {"num_good": 0},
        {"num_adversaries": 0},
        {"num_obstacles": -1},
        {"curriculum": True},
        {"terminate_on_success": True},
    ],
    SimpleReference: [{"local_ratio": -1}, {"benchmark_data": True}, {"N": 3}, {"num_agent_neighbors": None}],
}


@pytest.mark.parametrize("name", CASES)
@settings(max_examples=12)
@given(plan=plans, data=st.data())
def test_all_reports_equal_those_of_the_stock_environment(name: str, plan: Plan, data: st.DataObject) -> None:
    make, arguments = CASES[name]
    kwargs = data.draw(st.fixed_dictionaries({}, optional=arguments))
    assert_equal(config(name, **kwargs), make(plan.num_envs, **kwargs), plan)


@pytest.mark.slow
@pytest.mark.parametrize("continuous", [False, True], ids=["discrete", "continuous"])
@pytest.mark.parametrize("name", CASES)
def test_many_agent_steps_equal_those_of_the_stock_environment(name: str, continuous: bool) -> None:
    vector = CASES[name][0](64, continuous_actions=continuous)
    steps = AGENT_STEPS // len(vector.possible_agents) + 1
    comparison = compare(config(name, continuous_actions=continuous), vector, steps, seed=1)
    assert comparison.difference is None
    assert comparison.steps * len(vector.possible_agents) >= AGENT_STEPS
    assert comparison.episodes > steps / 30


def test_other_arguments_are_left_to_the_stock_environment() -> None:
    for make, rejected in NOT_IMPLEMENTED.items():
        for kwargs in rejected:
            with pytest.raises(UnsupportedArguments, match=next(iter(kwargs))):
                make(1, **kwargs)
    assert SimpleSpread(1, curriculum=False, num_agent_neighbors=None).possible_agents == tuple(
        f"agent_{number}" for number in range(3)
    )


SEEDS = np.array([0, 1, 7, 2**31 - 1])


def test_each_of_the_fifty_actions_moves_and_speaks() -> None:
    env, copies = SimpleReference(50), np.arange(50)
    env.reset(copies, copies)
    (rows,) = env.step(copies, np.column_stack([np.arange(50), np.zeros(50, dtype=np.int64)]).ravel())
    speaker, listener = rows.observations["observation"].reshape(50, 2, 21).swapaxes(0, 1)
    assert listener[:, 11:].argmax(axis=1).tolist() == [action // 5 for action in range(50)]
    assert (listener[:, 11:].sum(axis=1) == 1).all()
    directions = np.sign(speaker[:, :2]).tolist()
    assert directions == [[0, 0], [-1, 0], [1, 0], [0, -1], [0, 1]] * 10


STAY, LEFT, RIGHT, DOWN, UP = range(5)


def touching_agents(agents: int) -> int:
    """A seed with which agents 0 and 1 start in contact."""
    seeds = np.arange(1000)
    positions = positions_only(seeds, 2 * agents)
    return int(seeds[lengths(positions[0] - positions[1]) < SIZE][0])


def test_agents_that_meet_are_penalised() -> None:
    """Each of two agents accelerates towards the other."""
    env, copy = SimpleSpread(1, N=2, local_ratio=1), np.zeros(1, dtype=np.int64)
    (rows,) = env.reset(copy, np.array([touching_agents(2)]))
    rewards = []
    for _ in range(10):
        # The last two values before the messages are the relative position of the other agent.
        to_the_right = rows.observations["observation"][:, 8] > 0
        (rows,) = env.step(copy, np.where(to_the_right, RIGHT, LEFT))
        rewards += rows.rewards.tolist()
    assert set(rewards) == {0.0, -1.0}


CENTRAL = (85, 93, 133, 137)
"""Seeds with which a good agent starts near the centre, far from its adversary."""


def played(seed: int, actions: list[list[int]], **kwargs: Any) -> list[list[AgentRows]]:
    """Reports of one copy for each step, which equal those of the stock environment."""
    test, copy = (
        DifferentialTest(config("simple_tag_v3", **kwargs), SimpleTag(1, **kwargs)),
        np.zeros(1, dtype=np.int64),
    )
    test.reset(copy, np.array([seed]))
    reports = []
    for action in actions:
        test.step(copy, np.array(action))
        reports.append(list(test.rows))
    test.close()
    return reports


def test_agents_do_not_exceed_their_speeds() -> None:
    reports = played(0, [[RIGHT, LEFT]] * 25, num_adversaries=1, num_obstacles=0)
    speeds = [np.abs(rows.observations["observation"][0, :2]).max() for rows in reports[-1]]
    np.testing.assert_allclose(speeds, [1.0, 1.3], rtol=1e-6)


def test_all_adversaries_are_rewarded_for_each_contact() -> None:
    """The adversaries accelerate towards the good agent, which does not move."""
    env, copies = SimpleTag(200, num_adversaries=2, num_obstacles=0), np.arange(200)
    adversaries, good = env.reset(copies, copies)
    caught = 0
    for _ in range(25):
        # Velocity, position, the other adversary, then the good agent.
        towards = adversaries.observations["observation"][:, 6:8]
        horizontal = np.abs(towards[:, 0]) > np.abs(towards[:, 1])
        moves = np.where(horizontal, np.where(towards[:, 0] > 0, RIGHT, LEFT), np.where(towards[:, 1] > 0, UP, DOWN))
        actions = np.column_stack([moves.reshape(-1, 2), np.zeros(200, dtype=np.int64)]).ravel()
        adversaries, good = env.step(copies, actions)
        first, second = adversaries.rewards.reshape(-1, 2).T
        assert (first == second).all()
        assert set(first) <= {0, 10, 20}
        assert (good.rewards <= -first).all()
        caught += int((first > 0).sum())
    assert caught > 100


def test_penalties_at_their_limits() -> None:
    distances = np.array([0.0, np.nextafter(0.9, 0), 0.9, 0.95, np.nextafter(1.0, 0), 1.0, 2.0, 2.2, 1e300])
    with np.errstate(over="ignore"):
        found = bound_penalties(distances)
    assert found[:3].tolist() == [0, 0, 0]
    assert found[3] == (0.95 - 0.9) * 10
    assert found[5] == 1
    assert found[6] == np.exp(2.0)
    assert found[7:].tolist() == [10, 10]
    assert (np.diff(found) >= 0).all()


@pytest.mark.parametrize("rejected", [False, True])
def test_goals_and_positions_equal_those_of_numpy(rejected: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """rejected: as if NumPy drew the goals of every second seed again."""
    if rejected:
        integers = pcg64.integers

        def rejecting(halves: np.ndarray, high: int) -> tuple[np.ndarray, np.ndarray]:
            values, accepted = integers(halves, high)
            accepted[-1, ::2] = False
            values[:, ::2] = -1
            return values, accepted

        monkeypatch.setattr(pcg64, "integers", rejecting)
    for goals, landmarks in ((1, 1), (1, 2), (1, 3), (2, 3)):
        drawn, positions = goals_and_positions(SEEDS, goals, landmarks, entities=4)
        assert positions.shape == (4, 2, len(SEEDS))
        for i, seed in enumerate(SEEDS.tolist()):
            rng = np.random.default_rng(seed)
            assert drawn[:, i].tolist() == [rng.integers(landmarks) for _ in range(goals)]
            np.testing.assert_array_equal(positions[..., i], [rng.uniform(-1, 1, 2) for _ in range(4)])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_continuous_actions_and_messages_are_clipped(dtype: Any) -> None:
    """The league accepts actions that exceed the bounds by a relative rounding error of 1e-5."""
    kwargs, copy = {"continuous_actions": True}, np.zeros(1, dtype=np.int64)
    test = DifferentialTest(config("simple_spread_v3", N=2, **kwargs), SimpleSpread(1, N=2, **kwargs))
    test.reset(copy, copy)
    for action in ([0, 0, 1, 0, 1], [0, 1, 0, 1, 0], [0, -1e-5, 1 + 1e-5, 0.3, 0.7], [1] * 5, [0, -0.0, 0, 0, -0.0]):
        test.step(copy, np.array([action, action[::-1]], dtype=dtype))
    test.close()
    test = DifferentialTest(config("simple_reference_v3", **kwargs), SimpleReference(1, **kwargs))
    test.reset(copy, copy)
    for value in (0.0, -0.0, 1.0, 1 + 1e-5, -1e-5, 0.3):
        test.step(copy, np.full((2, 15), value, dtype=dtype))
        assert test.rows[0].observations["observation"][0, 11:].tolist() == [np.float32(np.clip(value, 0, 1))] * 10
    test.close()


def test_agents_in_contact_repel_each_other() -> None:
    for agents in (2, 3, 4):
        test = DifferentialTest(config("simple_spread_v3", N=agents), SimpleSpread(1, N=agents))
        copy = np.zeros(1, dtype=np.int64)
        test.reset(copy, np.array([touching_agents(agents)]))
        for _ in range(6):
            test.step(copy, np.full(agents, STAY))
        (rows,) = test.rows
        assert np.abs(rows.observations["observation"][:2, :2]).max(axis=1).min() > 0.1, "both agents move"
        test.close()


def test_the_adversary_is_apart_and_each_landmark_can_be_the_goal() -> None:
    """Good agents observe the goal first, then all landmarks."""
    env, copies = SimpleAdversary(100, N=3), np.arange(100)
    adversary, good = env.reset(copies, copies)
    assert adversary.agents.tolist() == [0] * 100
    assert good.envs.tolist() == np.repeat(copies, 3).tolist()
    assert good.agents.tolist() == [1, 2, 3] * 100
    observations = good.observations["observation"]
    goals, landmarks = observations[:, :2], observations[:, 2:8].reshape(-1, 3, 2)
    is_goal = (landmarks == goals[:, np.newaxis]).all(axis=2)
    assert (is_goal.sum(axis=1) == 1).all()
    assert (is_goal.sum(axis=0) > 60).all()


def test_a_good_agent_that_leaves_the_arena_is_penalised() -> None:
    for direction in (LEFT, RIGHT, DOWN, UP):
        reports = [
            report
            for seed in CENTRAL
            for report in played(seed, [[STAY, direction]] * 30, num_adversaries=1, num_obstacles=0, max_cycles=50)
        ]
        penalties = {-good.rewards[0] for _, good in reports}
        assert any(0 < penalty <= 1 for penalty in penalties), "near the border"
        assert any(1 < penalty < 10 for penalty in penalties), "outside"
        assert 10 in penalties, "far outside"
