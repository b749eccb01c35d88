"""SuperSuit's wrappers on all agents at once: values, dtypes and spaces equal SuperSuit's."""

from importlib import import_module
from typing import Any

import numpy as np
import pytest
import supersuit
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from league.config.environment import EnvironmentConfig
from league.environments.building import build
from league.environments.wrappers.transforms import Resize
from league.environments.wrappers.wrapping import BatchedWrappers

PISTONBALL = "pettingzoo.butterfly.pistonball_v6"
SMALL = {"n_pistons": 3, "max_cycles": 25, "render_mode": "rgb_array"}
PONG = "pettingzoo.butterfly.cooperative_pong_v6"
SPREAD, PURSUIT = "mpe2.simple_spread_v3", "pettingzoo.sisl.pursuit_v5"
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
    (SPREAD, {}, ["agent_indicator_v0", STACK]),
    (SPREAD, {}, ["pad_observations_v0", "agent_indicator_v0"]),
    (SPREAD, {}, [STACK, {"reshape_v0": {"shape": [4, 18]}}, {"dtype_v0": {"dtype": "float64"}}]),
    (PURSUIT, {"max_cycles": 15}, [FLOAT, SIZE, STACK, "flatten_v0"]),
]


def supersuit_environment(entry_point: str, kwargs: dict[str, Any], wrappers: list[Any]) -> Any:
    env = import_module(entry_point).parallel_env(**kwargs)
    for wrapper in wrappers:
        name, arguments = (wrapper, {}) if isinstance(wrapper, str) else next(iter(wrapper.items()))
        given = {key: tuple(value) if isinstance(value, list) else value for key, value in arguments.items()}
        env = getattr(supersuit, name)(env, **given)
    return env


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("case", CASES, ids=str)
def test_episodes_equal_supersuits(case: tuple[str, dict[str, Any], list[Any]]) -> None:
    entry_point, kwargs, wrappers = case
    ours = build(EnvironmentConfig(entry_point=entry_point, kwargs=kwargs, wrappers=wrappers))
    theirs = supersuit_environment(*case)
    assert isinstance(ours, BatchedWrappers)
    for agent in theirs.possible_agents:
        assert ours.observation_space(agent) == theirs.observation_space(agent)
        theirs.action_space(agent).seed(5)
    for seed in range(2):
        mine, _ = ours.reset(seed=seed)
        expected, _ = theirs.reset(seed=seed)
        kept: list[tuple[np.ndarray, np.ndarray]] = []
        while True:
            assert list(mine) == list(expected)
            for agent, observation in expected.items():
                assert mine[agent].dtype == observation.dtype
                np.testing.assert_array_equal(mine[agent], observation)
                kept.append((mine[agent], observation.copy()))
            if not theirs.agents:
                break
            actions = {agent: theirs.action_space(agent).sample() for agent in theirs.agents}
            mine, *_ = ours.step(dict(actions))
            expected, *_ = theirs.step(dict(actions))
        for array, at_its_time in kept[:40]:
            np.testing.assert_array_equal(array, at_its_time, err_msg="returned arrays must not be modified later")


@pytest.mark.parametrize(
    ("entry_point", "wrapper"),
    [
        (SPREAD, {"frame_stack_v1": {"stack_dim": 0}}),  # stacks images differently
        (SPREAD, {"frame_skip_v0": {"num_frames": 2}}),  # changes more than observations
        ("mpe2.simple_adversary_v3", "flatten_v0"),  # agents have different observation spaces
        (PURSUIT, {"resize_v1": {"x_size": 4, "y_size": 4, "linear_interp": False}}),
    ],
)
def test_unsupported_wrappers_remain_supersuits(entry_point: str, wrapper: Any) -> None:
    env = build(EnvironmentConfig(entry_point=entry_point, wrappers=[wrapper]))
    assert not isinstance(env, BatchedWrappers)
    env.reset(seed=0)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_resizing_equals_tinyscalers(data: st.DataObject) -> None:
    import tinyscaler

    sizes = st.integers(2, 60)
    height, width, to_height, to_width = (data.draw(sizes) for _ in range(4))
    channels = data.draw(st.sampled_from([1, 3, 4]))
    images = data.draw(arrays.arrays(np.uint8, (2, height, width, channels)))
    resized = Resize(height, width, to_height, to_width)(images, np.arange(2))
    for image, mine in zip(images, resized, strict=True):
        np.testing.assert_array_equal(mine, tinyscaler.scale(src=image, size=(to_width, to_height), mode="bilinear"))
