"""SuperSuit's wrappers by name, for both PettingZoo APIs, and those that are rejected."""

from typing import Any

import numpy as np
import pytest

from league.config.environment import EnvironmentConfig
from league.environments.building import action_space, build
from league.environments.lockstep import stock_stepping
from league.errors import ConfigError
from tests.conformance.stepping import lockstep

HERE = __name__
WALKER, SPREAD = "pettingzoo.sisl.multiwalker_v9", "mpe2.simple_spread_v3"
ADVERSARY, PISTONBALL = "mpe2.simple_adversary_v3", "pettingzoo.butterfly.pistonball_v6"
WRAPPERS: dict[str, tuple[str, dict[str, Any]]] = {
    "action_lambda_v1": (SPREAD, {"change_action_fn": f"{HERE}:same", "change_space_fn": f"{HERE}:same_space"}),
    "agent_indicator_v0": (SPREAD, {}),
    "black_death_v3": (SPREAD, {}),
    "clip_actions_v0": (WALKER, {}),
    "clip_reward_v0": (SPREAD, {"lower_bound": -1, "upper_bound": 1}),
    "color_reduction_v0": (PISTONBALL, {"mode": "full"}),
    "delay_observations_v0": (SPREAD, {"delay": 2}),
    "dtype_v0": (SPREAD, {"dtype": "float64"}),
    "flatten_v0": (PISTONBALL, {}),
    "frame_skip_v0": (SPREAD, {"num_frames": 2}),
    "frame_stack_v1": (SPREAD, {"stack_size": 2}),
    "frame_stack_v2": (SPREAD, {"stack_size": 2}),
    "max_observation_v0": (SPREAD, {"memory": 2}),
    "nan_noop_v0": (SPREAD, {"no_op_action": 0}),
    "nan_random_v0": (SPREAD, {}),
    "nan_zeros_v0": (SPREAD, {}),
    "normalize_obs_v0": ("pettingzoo.butterfly.knights_archers_zombies_v11", {}),
    "observation_lambda_v0": (SPREAD, {"change_observation_fn": f"{HERE}:doubled"}),
    "pad_action_space_v0": ("mpe2.simple_speaker_listener_v4", {}),
    "pad_observations_v0": (ADVERSARY, {}),
    "reshape_v0": (SPREAD, {"shape": [2, 9]}),
    "resize_v1": (PISTONBALL, {"x_size": 8, "y_size": 8}),
    "reward_lambda_v0": (SPREAD, {"change_reward_fn": f"{HERE}:halved"}),
    "scale_actions_v0": (WALKER, {"scale": 0.5}),
    "sticky_actions_v0": (SPREAD, {"repeat_action_probability": 0.3}),
}
REJECTED = {"concat_vec_envs_v1", "vectorize_aec_env_v0", "gym_vec_env_v0", "pettingzoo_env_to_vec_env_v1"}
REJECTED |= {"stable_baselines3_vec_env_v0", "stable_baselines_vec_env_v0"}


def same(action: Any, _space: Any) -> Any:
    return action


def same_space(space: Any) -> Any:
    return space


def doubled(observation: np.ndarray, _space: Any) -> np.ndarray:
    return observation * 2


def halved(reward: float) -> float:
    return reward / 2


def config(entry_point: str, *wrappers: Any, **more: Any) -> EnvironmentConfig:
    return EnvironmentConfig(entry_point=entry_point, wrappers=wrappers, **more)


def test_the_wrappers_are_those_of_supersuit() -> None:
    import supersuit

    names = {name for name in dir(supersuit) if name[-3:-1] == "_v" and name[-1].isdigit()}
    assert names == set(WRAPPERS) | REJECTED


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("api", ["aec", "parallel"])
@pytest.mark.parametrize("name", WRAPPERS)
def test_each_wrapper_steps_in_lockstep_and_follows_the_seed(name: str, api: Any) -> None:
    entry_point, arguments = WRAPPERS[name]
    kwargs = {"n_pistons": 3} if entry_point == PISTONBALL else {}
    wrapped = config(entry_point, {name: arguments}, api=api, kwargs=kwargs)
    env = build(wrapped)
    spaces = {agent: action_space(env, agent) for agent in env.possible_agents}
    envs = stock_stepping(wrapped, 2)
    first, again = (lockstep(envs, spaces, seeds, 6) for seeds in ([1, 2], [2, 1]))
    for seed in (1, 2):
        for agent, reports in first[seed].items():
            for one, other in zip(reports, again[seed][agent], strict=True):
                assert one[2:] == other[2:]
                np.testing.assert_array_equal(one[1]["observation"], other[1]["observation"])


@pytest.mark.parametrize("name", sorted(REJECTED))
def test_vector_environments_are_rejected(name: str) -> None:
    with pytest.raises(ConfigError, match=rf"{name} creates a vector environment"):
        build(config(SPREAD, name))


@pytest.mark.parametrize(
    ("wrappers", "message"),
    [
        (
            ["flatten_v0", {"resize_v1": {"x_size": 8, "y_size": 8}}],
            r"resize_v1 \(number 2\).*piston_0 has observations Box",
        ),
        ([{"color_reduction_v0": {"mode": "B"}}, "color_reduction_v0"], r"color_reduction_v0 \(number 2\).*3d image"),
        (["normalize_obs_v0"], r"normalize_obs_v0 \(number 1\)"),
        ([{"resize_v1": {"x": 8}}], r"resize_v1 \(number 1\).*'x'"),
        ([{"reshape_v0": {"shape": [3]}}], r"reshape_v0 \(number 1\).*as many elements"),
        (["frame_stack_v0"], "SuperSuit has no wrapper 'frame_stack_v0'.*use frame_stack_v1 instead"),
        (["frame_stak_v2"], "SuperSuit has no wrapper 'frame_stak_v2': did you mean 'frame_stack_v2'?"),
        (["utils"], "'utils' of SuperSuit is not a wrapper"),
        (
            [{"observation_lambda_v0": {"change_observation_fn": "no.such:thing"}}],
            "observation_lambda_v0.change_observation_fn: cannot import 'no.such'",
        ),
    ],
)
def test_invalid_wrappers_are_rejected_with_name_position_and_reason(wrappers: list[Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        build(config(PISTONBALL, *wrappers))


def test_an_agent_indicator_requires_equal_observation_spaces() -> None:
    with pytest.raises(ConfigError, match=r"agent_indicator_v0 \(number 1\).*pad_observations"):
        build(config(ADVERSARY, "agent_indicator_v0"))
    build(config(ADVERSARY, "pad_observations_v0", "agent_indicator_v0"))
