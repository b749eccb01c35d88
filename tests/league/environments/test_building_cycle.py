"""A cycle at a time gives the results of PettingZoo's conversion, without its redundant observations."""

from typing import Any

import numpy as np
import pytest
import supersuit
from mpe2 import simple_adversary_v3, simple_spread_v3, simple_world_comm_v3
from pettingzoo.butterfly import pistonball_v6

from league.config.environment import EnvironmentConfig
from league.environments.building import Cycle, build

PIXELS = [{"color_reduction_v0": {"mode": "B"}}, {"resize_v1": {"x_size": 42, "y_size": 42}}, "frame_stack_v1"]
CASES: dict[str, tuple[Any, dict[str, Any], list[Any]]] = {
    "mpe2.simple_spread_v3": (simple_spread_v3, {}, []),
    "mpe2.simple_adversary_v3": (simple_adversary_v3, {"continuous_actions": True}, []),
    "mpe2.simple_world_comm_v3": (simple_world_comm_v3, {}, ["pad_observations_v0", "agent_indicator_v0"]),
    "pettingzoo.butterfly.pistonball_v6": (
        pistonball_v6,
        {"n_pistons": 4, "max_cycles": 20, "render_mode": "rgb_array"},
        PIXELS,
    ),
}


def converted_environment(module: Any, kwargs: dict[str, Any], wrappers: list[Any]) -> Any:
    env = module.parallel_env(**kwargs)
    for wrapper in wrappers:
        name, arguments = (wrapper, {}) if isinstance(wrapper, str) else next(iter(wrapper.items()))
        env = getattr(supersuit, name)(env, **arguments)
    return env


@pytest.mark.parametrize("entry_point", CASES)
def test_steps_equal_pettingzoos_conversion(entry_point: str) -> None:
    module, kwargs, wrappers = CASES[entry_point]
    ours = build(EnvironmentConfig(entry_point=entry_point, kwargs=kwargs, wrappers=wrappers))
    theirs = converted_environment(module, kwargs, wrappers)
    for seed in range(2):
        mine, _ = ours.reset(seed=seed)
        expected, _ = theirs.reset(seed=seed)
        for agent in ours.possible_agents:
            ours.action_space(agent).seed(seed)
        while True:
            assert list(mine) == list(expected)
            for agent, observation in expected.items():
                np.testing.assert_array_equal(mine[agent], observation)
            if not ours.agents:
                break
            actions = {agent: ours.action_space(agent).sample() for agent in ours.agents}
            mine, *reports, _ = ours.step(dict(actions))
            expected, *due, _ = theirs.step(dict(actions))
            assert [dict(report) for report in reports] == [dict(report) for report in due]
            assert ours.agents == theirs.agents


def test_each_observation_is_computed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    env = build(EnvironmentConfig(entry_point="mpe2.simple_spread_v3"))
    assert isinstance(env, Cycle)
    env.reset(seed=0)
    observed = []
    observe = type(env.unwrapped).observe
    monkeypatch.setattr(
        type(env.unwrapped), "observe", lambda self, agent: observed.append(agent) or observe(self, agent)
    )
    env.step(dict.fromkeys(env.agents, 0))
    assert observed == env.agents
