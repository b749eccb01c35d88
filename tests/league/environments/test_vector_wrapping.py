"""SuperSuit's wrappers on vectorised environments: all reports equal those of the stock environment with SuperSuit."""

from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from league.config.environment import EnvironmentConfig
from league.environments.equality import compare
from league.environments.implementation import implementation
from league.environments.vector.vector_env import VectorEnv
from tests.support.environments.plans import Plan, assert_equal, plans
from tests.support.environments.vector_copies import VectorCopies
from tests.support.examples import examples

SPREAD, TAG = "mpe2.simple_spread_v3", "mpe2.simple_tag_v3"


PAD, INDICATOR = "pad_observations_v0", "agent_indicator_v0"


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
    choice = implementation(config)
    assert choice.vector is not None, choice.reason
    return choice.vector(num_envs, **config.kwargs)


AGENTS = ("left", "right")


STEPS = 4


PIXELS = np.arange(6 * 5 * 3).reshape(6, 5, 3)


def flicker(wrappers: Sequence[Any]) -> EnvironmentConfig:
    """The environment and its vectorised version, with wrappers."""
    return EnvironmentConfig.model_validate(
        {"entry_point": VectorFlicker.entry_point, "vector": f"{__name__}:VectorFlicker", "wrappers": wrappers}
    )


class Flicker(ParallelEnv):
    """Two agents see images that depend on the seed, the step and the other agent's last action."""

    metadata: ClassVar = {"name": "flicker"}

    def __init__(self) -> None:
        self.possible_agents = list(AGENTS)
        self.agents: list[str] = []

    def observation_space(self, agent: str) -> spaces.Space:
        return spaces.Box(0, 255, (6, 5, 3), np.uint8)

    def action_space(self, agent: str) -> spaces.Space:
        return spaces.Discrete(3)

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        self.agents, self._seed, self._step = list(AGENTS), seed or 0, 0
        return self._images(dict.fromkeys(AGENTS, 0)), {agent: {} for agent in AGENTS}

    def step(self, actions: dict[str, int]) -> tuple[dict, dict, dict, dict, dict]:
        self._step += 1
        rewards = {agent: float(actions[agent]) for agent in AGENTS}
        ended = dict.fromkeys(AGENTS, self._step == STEPS)
        going_on = dict.fromkeys(AGENTS, False)
        if self._step == STEPS:
            self.agents = []
        return self._images(actions), rewards, going_on, ended, {agent: {} for agent in AGENTS}

    def _images(self, actions: dict[str, int]) -> dict[str, NDArray]:
        opposite = [actions[agent] for agent in reversed(AGENTS)]
        offsets = [31 * self._step + 17 * number + 5 * action for number, action in enumerate(opposite)]
        pictures = [((PIXELS * (self._seed % 7 + 1) + offset) % 256).astype(np.uint8) for offset in offsets]
        return dict(zip(AGENTS, pictures, strict=True))


class VectorFlicker(VectorCopies):
    entry_point = f"{__name__}:Flicker"


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
    comparison = compare(config, vectorised(config, 7), steps=200, seed=0)
    assert comparison.difference is None
    assert comparison.episodes > 5


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
