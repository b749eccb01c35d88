"""SuperSuit's wrappers by name, for both PettingZoo APIs, and on all agents at once: values, dtypes and spaces equal
SuperSuit's.
"""

from importlib import import_module
from itertools import cycle
from typing import Any

import numpy as np
import pytest
import supersuit
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from league.config.environment import EnvironmentConfig
from league.environments.building import build
from league.environments.implementation import stock_stepping
from league.environments.wrappers.transforms import Resize
from league.environments.wrappers.wrapping import BatchedWrappers
from league.errors import ConfigError
from tests.conformance.stepping import assert_same_episode, lockstep

HERE = __name__
WALKER, SPREAD = "pettingzoo.sisl.multiwalker_v9", "mpe2.simple_spread_v3"
ADVERSARY, PURSUIT = "mpe2.simple_adversary_v3", "pettingzoo.sisl.pursuit_v5"
WORLD_COMM = "mpe2.simple_world_comm_v3"
PISTONBALL, PONG = "pettingzoo.butterfly.pistonball_v6", "pettingzoo.butterfly.cooperative_pong_v6"
WRAPPERS: dict[str, tuple[str, dict[str, Any]]] = {
    "action_lambda_v1": (SPREAD, {"change_action_fn": f"{HERE}:same", "change_space_fn": f"{HERE}:same"}),
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
    "reward_lambda_v0": (SPREAD, {"change_reward_fn": f"{HERE}:doubled"}),
    "scale_actions_v0": (WALKER, {"scale": 0.5}),
    "sticky_actions_v0": (SPREAD, {"repeat_action_probability": 0.3}),
}


REJECTED = {"concat_vec_envs_v1", "vectorize_aec_env_v0", "gym_vec_env_v0", "pettingzoo_env_to_vec_env_v1"}


REJECTED |= {"stable_baselines3_vec_env_v0", "stable_baselines_vec_env_v0"}


SMALL = {"n_pistons": 3, "max_cycles": 25, "render_mode": "rgb_array"}


BLUE, GREY = {"color_reduction_v0": {"mode": "B"}}, "color_reduction_v0"


SIZE = {"resize_v1": {"x_size": 42, "y_size": 31}}


STACK = {"frame_stack_v1": {"stack_size": 4}}


FLOAT = {"dtype_v0": {"dtype": "float32"}}


CASES: list[tuple[str, dict[str, Any], list[Any]]] = [
    (PISTONBALL, SMALL, [BLUE, {"resize_v1": {"x_size": 84, "y_size": 84}}, STACK]),
    (PISTONBALL, SMALL, [GREY, SIZE, FLOAT, "normalize_obs_v0", {"frame_stack_v1": {"stack_size": 3}}, "flatten_v0"]),
    (PISTONBALL, SMALL, [SIZE, "agent_indicator_v0", {"frame_stack_v1": {"stack_size": 2}}]),
    (PISTONBALL, SMALL, [BLUE, SIZE, {"agent_indicator_v0": {"type_only": True}}, {"dtype_v0": {"dtype": "int32"}}]),
    (PISTONBALL, SMALL, [FLOAT, SIZE, {"normalize_obs_v0": {"env_min": -1, "env_max": 3}}]),
    (PONG, {"max_cycles": 20, "render_mode": "rgb_array"}, [{"color_reduction_v0": {"mode": "G"}}, SIZE, STACK]),
    (SPREAD, {}, []),
    (ADVERSARY, {"continuous_actions": True}, []),
    (WORLD_COMM, {}, ["pad_observations_v0", "agent_indicator_v0"]),
    (SPREAD, {}, ["agent_indicator_v0", STACK]),
    (SPREAD, {}, ["pad_observations_v0", "agent_indicator_v0"]),
    (SPREAD, {}, [STACK, {"reshape_v0": {"shape": [4, 18]}}, {"dtype_v0": {"dtype": "float64"}}]),
    (PURSUIT, {"max_cycles": 15}, [FLOAT, SIZE, STACK, "flatten_v0"]),
]


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_resizing_equals_tinyscalers(data: st.DataObject) -> None:
    import tinyscaler

    sizes = st.integers(2, 60)
    height, width, to_height, to_width = (data.draw(sizes) for _ in range(4))
    channels = data.draw(st.sampled_from([1, 3, 4]))
    images = data.draw(arrays.arrays(np.uint8, (2, height, width, channels)))
    resized = Resize(height, width, to_height, to_width)(images, np.arange(2))
    for image, image_resized in zip(images, resized, strict=True):
        np.testing.assert_array_equal(
            image_resized, tinyscaler.scale(src=image, size=(to_width, to_height), mode="bilinear")
        )


def same(value: Any, _space: Any = None) -> Any:
    return value


def doubled(value: Any, _space: Any = None) -> Any:
    return value * 2


def config(entry_point: str, *wrappers: Any, **more: Any) -> EnvironmentConfig:
    return EnvironmentConfig(entry_point=entry_point, wrappers=wrappers, **more)


def test_the_wrappers_are_those_of_supersuit() -> None:
    names = {name for name in dir(supersuit) if name[-3:-1] == "_v" and name[-1].isdigit()}
    assert names == set(WRAPPERS) | REJECTED
    for name in REJECTED:
        with pytest.raises(ConfigError, match=rf"{name} creates a vector environment"):
            build(config(SPREAD, name))


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize(("name", "api"), zip(WRAPPERS, cycle(["aec", "parallel"])))
def test_each_wrapper_steps_in_lockstep_and_follows_the_seed(name: str, api: Any) -> None:
    entry_point, arguments = WRAPPERS[name]
    kwargs = {"n_pistons": 3} if entry_point == PISTONBALL else {}
    wrapped = config(entry_point, {name: arguments}, api=api, kwargs=kwargs)
    env = build(wrapped)
    spaces = {agent: env.action_space(agent) for agent in env.possible_agents}
    envs = stock_stepping(wrapped, 2)
    first, again = (lockstep(envs, spaces, seeds, 6) for seeds in ([1, 2], [2, 1]))
    for seed in (1, 2):
        assert_same_episode(again[seed], first[seed])


def test_invalid_wrappers_are_rejected_with_name_position_and_reason(subtests: pytest.Subtests) -> None:
    resized = {"resize_v1": {"x_size": 8, "y_size": 8}}
    for wrappers, message in (
        (["flatten_v0", resized], r"resize_v1 \(number 2\).*piston_0 has observations Box"),
        ([{"color_reduction_v0": {"mode": "B"}}, "color_reduction_v0"], r"color_reduction_v0 \(number 2\).*3d image"),
        (["normalize_obs_v0"], r"normalize_obs_v0 \(number 1\)"),
        ([{"resize_v1": {"x": 8}}], r"resize_v1 \(number 1\).*'x'"),
        ([{"reshape_v0": {"shape": [3]}}], r"reshape_v0 \(number 1\).*as many elements"),
        (["frame_stack_v0"], "SuperSuit has no wrapper 'frame_stack_v0'.*use frame_stack_v1 instead"),
        (["frame_stak_v2"], "SuperSuit has no wrapper 'frame_stak_v2': did you mean 'frame_stack_v2'?"),
        (["gymnasium"], "no wrapper 'gymnasium'"),
        (["utils"], "'utils' of SuperSuit is not a wrapper"),
        (
            [{"observation_lambda_v0": {"change_observation_fn": "no.such:thing"}}],
            "observation_lambda_v0.change_observation_fn: cannot import 'no.such'",
        ),
    ):
        with subtests.test(wrappers=wrappers), pytest.raises(ConfigError, match=message):
            build(config(PISTONBALL, *wrappers))
    with pytest.raises(ConfigError, match=r"agent_indicator_v0 \(number 1\).*pad_observations"):
        build(config(ADVERSARY, "agent_indicator_v0"))
    build(config(ADVERSARY, "pad_observations_v0", "agent_indicator_v0"))
    with pytest.raises(ConfigError, match=r"flatten_v0 \(number 1\).*RLlib"):
        build(config("policy_league.examples.traffic:crossing", "flatten_v0"))


def with_supersuit(env: Any, wrappers: list[Any]) -> Any:
    for wrapper in wrappers:
        name, arguments = (wrapper, {}) if isinstance(wrapper, str) else next(iter(wrapper.items()))
        values = {key: tuple(value) if isinstance(value, list) else value for key, value in arguments.items()}
        env = getattr(supersuit, name)(env, **values)
    return env


def assert_same_episodes(ours: Any, theirs: Any) -> None:
    """Two Parallel environments have the same spaces, and report the same in two episodes."""
    for agent in theirs.possible_agents:
        assert ours.observation_space(agent) == theirs.observation_space(agent)
        theirs.action_space(agent).seed(5)
    for seed in range(2):
        actual, _ = ours.reset(seed=seed)
        expected, _ = theirs.reset(seed=seed)
        returned: list[tuple[np.ndarray, np.ndarray]] = []
        while True:
            assert list(actual) == list(expected)
            for agent, observation in expected.items():
                assert actual[agent].dtype == observation.dtype
                np.testing.assert_array_equal(actual[agent], observation)
                returned.append((actual[agent], observation.copy()))
            if not theirs.agents:
                break
            actions = {agent: theirs.action_space(agent).sample() for agent in theirs.agents}
            actual, *reports, _ = ours.step(dict(actions))
            expected, *due, _ = theirs.step(dict(actions))
            assert [dict(report) for report in reports] == [dict(report) for report in due]
            assert ours.agents == theirs.agents
        for array, at_its_time in returned[:40]:
            np.testing.assert_array_equal(array, at_its_time, err_msg="returned arrays must not be modified later")


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("case", CASES, ids=str)
def test_episodes_equal_supersuits(case: tuple[str, dict[str, Any], list[Any]]) -> None:
    entry_point, kwargs, wrappers = case
    ours = build(EnvironmentConfig(entry_point=entry_point, kwargs=kwargs, wrappers=wrappers))
    assert isinstance(ours, BatchedWrappers) == (bool(wrappers) and entry_point != WORLD_COMM)
    assert_same_episodes(ours, with_supersuit(import_module(entry_point).parallel_env(**kwargs), wrappers))


def test_unsupported_wrappers_remain_supersuits() -> None:
    for entry_point, wrapper in (
        (SPREAD, {"frame_stack_v1": {"stack_dim": 0}}),  # stacks images differently
        (SPREAD, {"frame_skip_v0": {"num_frames": 2}}),  # changes more than observations
        (ADVERSARY, "flatten_v0"),  # agents have different observation spaces
        (PURSUIT, {"resize_v1": {"x_size": 4, "y_size": 4, "linear_interp": False}}),
    ):
        env = build(config(entry_point, wrapper))
        assert not isinstance(env, BatchedWrappers)
        env.reset(seed=0)
