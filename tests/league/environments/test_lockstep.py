"""Lockstep equals the plain loop of each API, for unmodified environments."""

import importlib
from collections.abc import Callable
from typing import Any

import pytest

from league.config.environment import EnvironmentConfig
from league.environments.lockstep import stock_stepping
from league.environments.stepping import each_agent_alone
from policy_league.examples import two_step
from policy_league.examples.traffic import crossing
from tests.conformance.stepping import assert_abandoning_conforms, assert_states_conform, assert_stepping_conforms
from tests.support.environments.simultaneous import meeting, rllib_meeting

PARALLEL: dict[str, dict[str, Any]] = {
    "mpe2.simple_spread_v3": {},
    "mpe2.simple_world_comm_v3": {"continuous_actions": True},
    "pettingzoo.classic.rps_v2": {"max_cycles": 6},
    "pettingzoo.butterfly.knights_archers_zombies_v11": {"max_cycles": 120, "spawn_delay": 2},
    "pettingzoo.sisl.multiwalker_v9": {"max_cycles": 40},
}
AEC: dict[str, dict[str, Any]] = {
    "pettingzoo.classic.leduc_holdem_v4": {},
    "pettingzoo.classic.texas_holdem_no_limit_v6": {"num_players": 3},
    "pettingzoo.classic.tictactoe_v3": {},
}
OWN: dict[str, tuple[Any, dict[str, Any]]] = {
    "tests.support.environments.simultaneous:meeting": (
        meeting,
        {"arrives": [0, 2, 1, 0], "leaves": [4, 5, 2, 3], "truncated": [1, 2]},
    ),
    "tests.support.environments.simultaneous:rllib_meeting": (rllib_meeting, {"ends": 4}),
    "policy_league.examples.traffic:crossing": (crossing, {}),
    "policy_league.examples.two_step:parallel_env": (two_step.parallel_env, {}),
    "policy_league.examples.two_step:multi_agent_env": (two_step.multi_agent_env, {}),
}


Case = tuple[EnvironmentConfig, Callable[[], Any]]


@pytest.fixture(params=[*PARALLEL, *AEC, *OWN])
def case(request: pytest.FixtureRequest) -> Case:
    """An environment's configuration, and a function that creates the unmodified one."""
    entry_point = request.param
    if entry_point in OWN:
        make, kwargs = OWN[entry_point]
    elif entry_point in PARALLEL:
        make, kwargs = importlib.import_module(entry_point).parallel_env, PARALLEL[entry_point]
    else:
        make, kwargs = importlib.import_module(entry_point).env, AEC[entry_point]
    return EnvironmentConfig(entry_point=entry_point, kwargs=kwargs), lambda: make(**kwargs)


@pytest.mark.parametrize("num_envs", [pytest.param(1, marks=pytest.mark.slow), 3])
def test_lockstep_equals_the_plain_loop(case: Case, num_envs: int) -> None:
    config, stock = case
    assert_stepping_conforms(lambda n: stock_stepping(config, n), stock, seeds=[11, 12, 13, 14], num_envs=num_envs)


def test_an_abandoned_episode_has_no_effect_on_the_next(case: Case) -> None:
    config, stock = case
    assert_abandoning_conforms(lambda n: stock_stepping(config, n), stock, seeds=[11, 12, 13, 14], num_envs=2)


@pytest.mark.parametrize("num_envs", [1, 3])
@pytest.mark.parametrize(
    "entry_point",
    [
        "mpe2.simple_spread_v3",
        "policy_league.examples.two_step:parallel_env",
        "policy_league.examples.two_step:multi_agent_env",
    ],
)
def test_states_equal_those_of_the_plain_loop(entry_point: str, num_envs: int) -> None:
    module, _, name = entry_point.partition(":")
    stock = getattr(importlib.import_module(module), name or "parallel_env")
    config = EnvironmentConfig(entry_point=entry_point)
    assert_states_conform(
        lambda n: stock_stepping(config, n, states=True), stock, seeds=[11, 12, 13, 14], num_envs=num_envs
    )


def test_environments_without_state_return_none() -> None:
    env = stock_stepping(EnvironmentConfig(entry_point="pettingzoo.classic.rps_v2"), 2, states=True)
    turn = env.start(each_agent_alone(range(2), 2))
    assert (turn.states, turn.last_states) == (None, None)
    env.close()
