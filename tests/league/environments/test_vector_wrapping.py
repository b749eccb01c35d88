"""SuperSuit's wrappers on vectorised environments: all reports equal those of the stock environment with SuperSuit."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from league.config.environment import EnvironmentConfig
from league.environments.implementation import implementation
from league.environments.vector.equality import compare
from league.environments.vector.vector_env import VectorEnv
from tests.support.environments.flicker import flicker
from tests.support.environments.plans import Plan, assert_equal, plans
from tests.support.examples import examples

SPREAD, TAG, REFERENCE = "mpe2.simple_spread_v3", "mpe2.simple_tag_v3", "mpe2.simple_reference_v3"


PAD, INDICATOR = "pad_observations_v0", "agent_indicator_v0"


CONTINUOUS = {"continuous_actions": True}


wrappers = st.sampled_from(
    [
        PAD,
        "pad_action_space_v0",
        "flatten_v0",
        {"dtype_v0": {"dtype": "float64"}},
        {"dtype_v0": {"dtype": "float16"}},
        {"frame_stack_v1": {"stack_size": 2}},
        {"frame_stack_v1": {"stack_size": 3}},
        "clip_reward_v0",
        {"clip_reward_v0": {"lower_bound": -0.5, "upper_bound": 0}},
    ]
)


same_spaces = st.lists(wrappers | st.sampled_from([INDICATOR, {INDICATOR: {"type_only": True}}]), max_size=4)


def environment(entry_point: str, wrappers: list[Any], **kwargs: Any) -> EnvironmentConfig:
    return EnvironmentConfig.model_validate({"entry_point": entry_point, "kwargs": kwargs, "wrappers": wrappers})


TWO_ADVERSARIES = partial(environment, TAG, num_adversaries=2, max_cycles=4)


environments = st.one_of(
    same_spaces.map(partial(environment, SPREAD, N=2, max_cycles=4)),
    same_spaces.map(partial(environment, REFERENCE, max_cycles=4)),
    st.lists(wrappers, max_size=3).map(TWO_ADVERSARIES),
    same_spaces.map(lambda others: TWO_ADVERSARIES([PAD, *others])),  # an indicator needs equal spaces
    st.lists(wrappers | st.sampled_from(["clip_actions_v0", {"scale_actions_v0": {"scale": 0.7}}]), max_size=4).map(
        partial(environment, SPREAD, N=2, max_cycles=4, continuous_actions=True)
    ),
)


@pytest.mark.filterwarnings("ignore::UserWarning", "ignore::RuntimeWarning")
@pytest.mark.parametrize("count", [10, pytest.param(250, marks=pytest.mark.slow)])
def test_all_reports_equal_those_of_the_stock_environment(count: int) -> None:
    @settings(examples(count) if count > 10 else settings(max_examples=count))
    @given(plans, environments)
    def check(plan: Plan, config: EnvironmentConfig) -> None:
        assert_equal(config, vectorised(config, plan.num_envs), plan)

    check()


CLASSIC = "pettingzoo.classic."


def vectorised(config: EnvironmentConfig, num_envs: int) -> VectorEnv:
    found = implementation(config)
    assert found.vector is not None, found.reason
    return found.vector(num_envs, **config.kwargs)


GREY, FLOAT = {"color_reduction_v0": {"mode": "full"}}, {"dtype_v0": {"dtype": "float32"}}


OF_IMAGES: list[list[Any]] = [
    [],
    [GREY],
    [{"color_reduction_v0": {"mode": "G"}}, {"frame_stack_v1": {"stack_size": 3}}],
    [GREY, {"resize_v1": {"x_size": 3, "y_size": 4}}],
    [{"resize_v1": {"x_size": 9, "y_size": 2}}],
    [{"resize_v1": {"x_size": 2, "y_size": 3, "linear_interp": True}}],
    [{"reshape_v0": {"shape": [15, 6]}}],
    [FLOAT, "normalize_obs_v0"],
    [FLOAT, {"normalize_obs_v0": {"env_min": -1, "env_max": 0}}, "flatten_v0", INDICATOR],
]


GAMES = [f"{CLASSIC}{name}" for name in ("connect_four_v3", "tictactoe_v3", "leduc_holdem_v4", "rps_v2")]


BOUNDS: list[dict[str, float]] = [{}, {"lower_bound": -0.25, "upper_bound": 0.75}, {"lower_bound": -0.5}]


@pytest.mark.parametrize(
    "config",
    [
        *(environment(game, [{"clip_reward_v0": bounds}]) for game in GAMES[:3] for bounds in BOUNDS[:2]),
        environment(GAMES[3], [{"clip_reward_v0": BOUNDS[2]}], max_cycles=3),
        *map(flicker, OF_IMAGES),
    ],
    ids=lambda config: f"{config.entry_point} {[wrapper.name for wrapper in config.wrappers]}",
)
def test_games_and_images_equal_those_of_the_stock_environment(config: EnvironmentConfig) -> None:
    comparison = compare(config, vectorised(config, 7), steps=400, seed=0)
    assert comparison.difference is None
    assert comparison.episodes > 10


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    "config",
    [
        environment(SPREAD, [{"frame_stack_v1": {"stack_size": 4}}, INDICATOR, "clip_reward_v0"]),
        environment(TAG, [PAD, "pad_action_space_v0", INDICATOR, {"frame_stack_v1": {"stack_size": 2}}]),
    ],
    ids=["spread", "tag"],
)
def test_a_long_comparison_finds_no_difference(config: EnvironmentConfig) -> None:
    assert compare(config, vectorised(config, 32), steps=10_000, seed=1).difference is None


def test_other_wrappers_are_stepped_in_lockstep() -> None:
    for entry_point, wrapper, reason in (
        (SPREAD, {"frame_stack_v1": {"stack_dim": 0}}, "frame_stack_v1 has no vectorised version for its arguments"),
        (SPREAD, "black_death_v3", "black_death_v3 has no vectorised version"),
        (SPREAD, {"sticky_actions_v0": {"repeat_action_probability": 0.5}}, "wrapper sticky_actions_v0"),
        (SPREAD, "clip_actions_v0", "actions in a Box only"),
        (SPREAD, {"clip_reward_v0": {"lower_bound": 0.5}}, "bounds on both sides of 0"),
        (GAMES[3], {"frame_stack_v1": {"stack_size": 2}}, "observations in Discrete"),
        (GAMES[0], "pad_action_space_v0", "simultaneous actions only"),
    ):
        choice = implementation(environment(entry_point, [wrapper]))
        assert choice.vector is None
        assert choice.reason.startswith("It is stepped in lockstep, because wrapper ")
        assert reason in choice.reason


def test_padded_rows_are_in_the_order_of_the_agents() -> None:
    env = vectorised(environment("mpe2.simple_adversary_v3", [PAD, INDICATOR]), 2)
    (rows,) = env.reset(np.arange(2), np.arange(2))
    assert rows.envs.tolist() == [0, 0, 0, 1, 1, 1]
    assert rows.agents.tolist() == [0, 1, 2, 0, 1, 2]
    observations = rows.observations["observation"]
    assert observations.shape == (6, 13)
    assert (observations[:, -3:] == np.tile(np.eye(3), (2, 1))).all()
    assert (observations[::3, 8:10] == 0).all()


def test_frames_of_an_abandoned_episode_are_forgotten() -> None:
    env, copies = vectorised(environment(SPREAD, [{"frame_stack_v1": {"stack_size": 2}}]), 2), np.arange(2)
    env.reset(copies, copies)
    env.step(copies, np.zeros(6, dtype=np.int64))
    (rows,) = env.reset(copies[1:], copies[:1])
    frames = rows.observations["observation"].reshape(3, 2, -1)
    assert (frames[:, 0] == 0).all()
    assert frames[:, 1].any(axis=1).all()
