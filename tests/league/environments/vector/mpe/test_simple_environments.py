"""The vectorised MPE environments: reports equal those of stock, which arguments are implemented, and the rules."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from league.config.environment import EnvironmentConfig
from league.environments.equality import DifferentialTest, compare
from league.environments.vector.mpe.initial_states import goals_and_positions
from league.environments.vector.mpe.particle_env import ParticleEnv
from league.environments.vector.mpe.simple_adversary import SimpleAdversary
from league.environments.vector.mpe.simple_spread import SimpleSpread
from league.environments.vector.mpe.simple_tag import SimpleTag, bound_penalties
from league.environments.vector.vector_env import UnsupportedArguments
from league.random import pcg64
from tests.support.environments.plans import Phase, Plan, assert_equal, plans


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


STAY, LEFT, RIGHT, DOWN, UP = range(5)


def test_agents_that_do_not_turn_reach_their_speeds_and_leave_the_arena() -> None:
    """With these seeds the good agent starts near the centre, far from its adversary, which then stays."""
    arguments: dict[str, Any] = {"num_adversaries": 1, "num_obstacles": 0, "max_cycles": 50}
    whole = [Phase([True] * 4, [False] * 4, calls=30)]
    for choices in ([STAY, LEFT], [STAY, RIGHT], [STAY, DOWN], [STAY, UP], [RIGHT, LEFT]):
        plan = Plan(4, whole, bytes(choices), seeds=[85, 93, 133, 137])
        assert_equal(config("simple_tag_v3", **arguments), SimpleTag(4, **arguments), plan)


def test_penalties_at_their_limits() -> None:
    distances = np.array([0.0, np.nextafter(0.9, 0), 0.9, 0.95, np.nextafter(1.0, 0), 1.0, 2.0, 2.2, 1e300])
    with np.errstate(over="ignore"):
        penalties = bound_penalties(distances)
    assert penalties[:3].tolist() == [0, 0, 0]
    assert penalties[3] == (0.95 - 0.9) * 10
    assert penalties[5] == 1
    assert penalties[6] == np.exp(2.0)
    assert penalties[7:].tolist() == [10, 10]
    assert (np.diff(penalties) >= 0).all()


SEEDS = np.array([0, 1, 7, 2**31 - 1])


@pytest.mark.parametrize("rejected", [False, True])
def test_goals_and_positions_equal_those_of_numpy(rejected: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """rejected: as if NumPy drew the goals of every second seed again."""
    if rejected:
        integers = pcg64.integers

        def rejecting(halves: np.ndarray, high: int) -> tuple[np.ndarray, np.ndarray]:
            values, accepted = integers(halves, high)
            accepted[::2] = False
            values[::2] = -1
            return values, accepted

        monkeypatch.setattr(pcg64, "integers", rejecting)
    for landmarks in (1, 2, 3):
        goals, positions = goals_and_positions(SEEDS, landmarks, entities=4)
        assert positions.shape == (4, 2, len(SEEDS))
        for i, seed in enumerate(SEEDS.tolist()):
            rng = np.random.default_rng(seed)
            assert goals[i] == rng.integers(landmarks)
            np.testing.assert_array_equal(positions[..., i], [rng.uniform(-1, 1, 2) for _ in range(4)])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_continuous_actions_are_clipped(dtype: Any) -> None:
    """The league accepts actions that exceed the bounds by a relative rounding error of 1e-5."""
    kwargs, copy = {"continuous_actions": True}, np.zeros(1, dtype=np.int64)
    test = DifferentialTest(config("simple_spread_v3", N=2, **kwargs), SimpleSpread(1, N=2, **kwargs))
    test.reset(copy, copy)
    for action in ([0, 0, 1, 0, 1], [0, 1, 0, 1, 0], [0, -1e-5, 1 + 1e-5, 0.3, 0.7], [1] * 5, [0, -0.0, 0, 0, -0.0]):
        test.step(copy, np.array([action, action[::-1]], dtype=dtype))
    test.close()
