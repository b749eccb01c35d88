"""What holds for all vectorised MPE environments: reports equal those of stock, and which arguments are implemented."""

from dataclasses import dataclass
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from league.config.environment import EnvironmentConfig
from league.environments.vector.equality import compare
from league.environments.vector.mpe.particle_env import ParticleEnv
from league.environments.vector.mpe.simple_adversary import SimpleAdversary
from league.environments.vector.mpe.simple_reference import SimpleReference
from league.environments.vector.mpe.simple_spread import SimpleSpread
from league.environments.vector.mpe.simple_tag import SimpleTag
from league.environments.vector.vector_env import UnsupportedArguments
from tests.support.environments.plans import Plan, assert_equal, plans

COMMON = {"max_cycles": st.integers(1, 12), "continuous_actions": st.booleans()}
RATIO = {"local_ratio": st.sampled_from([0, 0.25, 0.5, 0.9, 1])}
AGENT_STEPS = 100_000


@dataclass(frozen=True)
class Case:
    """An environment. arguments: strategies of those that it implements. rejected: some that it does not."""

    make: Any
    arguments: dict[str, st.SearchStrategy[Any]]
    rejected: tuple[dict[str, Any], ...]

    def vector(self, num_envs: int, **kwargs: Any) -> ParticleEnv:
        made: ParticleEnv = self.make(num_envs, **kwargs)
        return made


CASES = {
    "simple_spread_v3": Case(
        SimpleSpread,
        {"N": st.integers(1, 4), **RATIO, **COMMON, "max_cycles": st.integers(0, 12)},
        (
            {"N": 0},
            {"N": 2.0},
            {"local_ratio": 1.5},
            {"local_ratio": None},
            {"dynamic_rescaling": False},
            {"benchmark_data": True},
            {"curriculum": True},
            {"terminate_on_success": True},
            {"num_agent_neighbors": 1},
            {"num_landmark_neighbors": 1},
            {"render_mode": "rgb_array"},
            {"unknown": 1},
        ),
    ),
    "simple_adversary_v3": Case(
        SimpleAdversary,
        {"N": st.integers(1, 4), **COMMON},
        ({"N": 0}, {"num_agent_neighbors": 1}, {"benchmark_data": True}, {"local_ratio": 0.5}, {"curriculum": False}),
    ),
    "simple_tag_v3": Case(
        SimpleTag,
        {
            "num_good": st.integers(1, 2),
            "num_adversaries": st.integers(1, 3),
            "num_obstacles": st.integers(0, 2),
            **COMMON,
        },
        (
            {"num_good": 0},
            {"num_adversaries": 0},
            {"num_obstacles": -1},
            {"curriculum": True},
            {"terminate_on_success": True},
        ),
    ),
    "simple_reference_v3": Case(
        SimpleReference,
        {**RATIO, **COMMON},
        ({"local_ratio": -1}, {"benchmark_data": True}, {"N": 3}, {"num_agent_neighbors": None}),
    ),
}


def config(name: str, **kwargs: Any) -> EnvironmentConfig:
    return EnvironmentConfig(entry_point=f"mpe2.{name}", kwargs=kwargs)


@pytest.mark.parametrize("name", CASES)
@settings(max_examples=12)
@given(plan=plans, data=st.data())
def test_all_reports_equal_those_of_the_stock_environment(name: str, plan: Plan, data: st.DataObject) -> None:
    case = CASES[name]
    kwargs = data.draw(st.fixed_dictionaries({}, optional=case.arguments))
    assert_equal(config(name, **kwargs), case.vector(plan.num_envs, **kwargs), plan)


@pytest.mark.slow
@pytest.mark.parametrize("continuous", [False, True], ids=["discrete", "continuous"])
@pytest.mark.parametrize("name", CASES)
def test_many_agent_steps_equal_those_of_the_stock_environment(name: str, continuous: bool) -> None:
    vector = CASES[name].vector(64, continuous_actions=continuous)
    steps = AGENT_STEPS // len(vector.possible_agents) + 1
    found = compare(config(name, continuous_actions=continuous), vector, steps, seed=1)
    assert found.difference is None
    assert found.steps * len(vector.possible_agents) >= AGENT_STEPS
    assert found.episodes > steps / 30


@pytest.mark.parametrize(
    ("name", "kwargs"), [(name, kwargs) for name, case in CASES.items() for kwargs in case.rejected], ids=str
)
def test_other_arguments_are_left_to_the_stock_environment(name: str, kwargs: dict[str, Any]) -> None:
    with pytest.raises(UnsupportedArguments, match=next(iter(kwargs))):
        CASES[name].vector(1, **kwargs)
