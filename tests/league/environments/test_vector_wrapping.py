"""SuperSuit's wrappers on vectorised environments: all reports equal those of the stock environment with SuperSuit."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from league.config.environment import EnvironmentConfig
from league.environments.implementation import implementation
from league.environments.vector.equality import compare
from league.environments.vector.mpe.simple_tag import SimpleTag
from league.environments.vector.vector_env import VectorEnv
from tests.support.environments.flicker import flicker
from tests.support.environments.mutants import Mutation, mutated
from tests.support.environments.plans import Plan, assert_equal, plans
from tests.support.examples import examples

SPREAD, TAG, REFERENCE = "mpe2.simple_spread_v3", "mpe2.simple_tag_v3", "mpe2.simple_reference_v3"
PAD, INDICATOR = "pad_observations_v0", "agent_indicator_v0"
CONTINUOUS = {"continuous_actions": True}

Wrapped = tuple[tuple[str, dict[str, Any]], list[Any]]
"""((entry point, arguments), wrappers)."""

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
environments = st.one_of(
    st.tuples(st.just((SPREAD, {"N": 2, "max_cycles": 4})), same_spaces),
    st.tuples(st.just((REFERENCE, {"max_cycles": 4})), same_spaces),
    st.tuples(st.just((TAG, {"num_adversaries": 2, "max_cycles": 4})), st.lists(wrappers, max_size=3)),
    # An indicator needs equal spaces.
    st.tuples(st.just((TAG, {"num_adversaries": 2, "max_cycles": 4})), same_spaces.map(lambda others: [PAD, *others])),
    st.tuples(
        st.just((SPREAD, {"N": 2, "max_cycles": 4, **CONTINUOUS})),
        st.lists(wrappers | st.sampled_from(["clip_actions_v0", {"scale_actions_v0": {"scale": 0.7}}]), max_size=4),
    ),
)


def environment(entry_point: str, wrappers: list[Any], **kwargs: Any) -> EnvironmentConfig:
    return EnvironmentConfig.model_validate({"entry_point": entry_point, "kwargs": kwargs, "wrappers": wrappers})


def vectorised(config: EnvironmentConfig, num_envs: int) -> VectorEnv:
    found = implementation(config)
    assert found.vector is not None, found.reason
    return found.vector(num_envs, **config.kwargs)


def check(plan: Plan, wrapped: Wrapped) -> None:
    (entry_point, kwargs), chosen = wrapped
    config = environment(entry_point, chosen, **kwargs)
    assert_equal(config, vectorised(config, plan.num_envs), plan)


@pytest.mark.filterwarnings("ignore::UserWarning", "ignore::RuntimeWarning")
@settings(max_examples=10)
@given(plans, environments)
def test_all_reports_equal_those_of_the_stock_environment(plan: Plan, wrapped: Wrapped) -> None:
    check(plan, wrapped)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning", "ignore::RuntimeWarning")
@examples(250)
@given(plans, environments)
def test_many_combinations_equal_the_stock_environment(plan: Plan, wrapped: Wrapped) -> None:
    check(plan, wrapped)


@pytest.mark.parametrize("name", ["connect_four_v3", "tictactoe_v3", "leduc_holdem_v4"])
@pytest.mark.parametrize("bounds", [{}, {"lower_bound": -0.25, "upper_bound": 0.75}], ids=str)
def test_rewards_of_turn_based_games_are_clipped(name: str, bounds: dict[str, float]) -> None:
    config = environment(f"pettingzoo.classic.{name}", [{"clip_reward_v0": bounds}])
    found = compare(config, vectorised(config, 8), steps=500, seed=0)
    assert found.difference is None
    assert found.episodes > 10


def test_rewards_of_simultaneous_games_are_clipped() -> None:
    config = environment("pettingzoo.classic.rps_v2", [{"clip_reward_v0": {"lower_bound": -0.5}}], max_cycles=3)
    env, copies = vectorised(config, 9), np.arange(9)
    env.reset(copies, copies)
    (rows,) = env.step(copies, np.array([(a, b) for a in range(3) for b in range(3)]).ravel())
    assert set(rows.rewards.tolist()) == {-0.5, 0.0, 1.0}
    assert compare(config, vectorised(config, 8), steps=500, seed=0).difference is None


GREY = {"color_reduction_v0": {"mode": "full"}}
FLOAT = {"dtype_v0": {"dtype": "float32"}}


@pytest.mark.parametrize(
    "wrappers",
    [
        [],
        [GREY],
        [{"color_reduction_v0": {"mode": "G"}}, {"frame_stack_v1": {"stack_size": 3}}],
        [GREY, {"resize_v1": {"x_size": 3, "y_size": 4}}],
        [{"resize_v1": {"x_size": 9, "y_size": 2}}],
        [{"resize_v1": {"x_size": 2, "y_size": 3, "linear_interp": True}}],
        [{"reshape_v0": {"shape": [15, 6]}}],
        [FLOAT, "normalize_obs_v0"],
        [FLOAT, {"normalize_obs_v0": {"env_min": -1, "env_max": 0}}, "flatten_v0", INDICATOR],
    ],
    ids=str,
)
def test_images_equal_those_of_the_stock_environment(wrappers: list[Any]) -> None:
    config = flicker(wrappers)
    found = compare(config, vectorised(config, 5), steps=300, seed=0)
    assert found.difference is None
    assert found.episodes > 10


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


WRAPPING, TRANSFORMS = "league.environments.vector_wrapping", "league.environments.wrappers.transforms"
MUTANTS = [
    (TRANSFORMS, "self._frames[slots] = 0", "pass"),
    (TRANSFORMS, "self._frames[slots] = 0", "self._frames[:] = 0"),
    (TRANSFORMS, "self._frames[slots] = frames", "pass"),
    (TRANSFORMS, "frames = self._frames[slots]", "frames = self._frames[: len(slots)]"),
    (TRANSFORMS, "self._of_agent[slots % len(self._of_agent)]", "self._of_agent[slots // len(self._of_agent) % 2]"),
    (TRANSFORMS, "[(0, 0), *missing]", "[(0, 0), *(pair[::-1] for pair in missing)]"),
    (WRAPPING, "np.clip(rewards, lowest, highest)", "np.clip(rewards, lowest, 1)"),
    (WRAPPING, "0.0 + np.clip(rewards", "-np.clip(-rewards"),
    (WRAPPING, "np.clip(rewards, lowest", "np.float32(1) * np.clip(rewards.astype(np.float32), lowest"),
    (WRAPPING, "np.lexsort((rows.agents, rows.envs))", "np.argsort(rows.agents, kind='stable')"),
    (WRAPPING, "rows.envs * len(self.possible_agents) + rows.agents", "rows.agents"),
    (WRAPPING, ".astype(self._dtypes[agent], copy=False)", ".astype(np.float32)"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("module", "old", "new"), MUTANTS)
def test_each_mutant_is_found(module: str, old: str, new: str) -> None:
    bounds = {"lower_bound": -0.5, "upper_bound": 0}
    chosen = [{"dtype_v0": {"dtype": "float64"}}, PAD, INDICATOR, "frame_stack_v1", {"clip_reward_v0": bounds}]
    config = environment(TAG, chosen, max_cycles=4)
    with mutated(Mutation(module, old, new), [TRANSFORMS, WRAPPING]) as mutant:
        vector = mutant.wrapped_vector(SimpleTag, config)(8, **config.kwargs)
        assert compare(config, vector, steps=2000, seed=0).difference is not None


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("entry_point", "chosen"),
    [
        (SPREAD, [{"frame_stack_v1": {"stack_size": 4}}, INDICATOR, "clip_reward_v0"]),
        (TAG, [PAD, "pad_action_space_v0", INDICATOR, {"frame_stack_v1": {"stack_size": 2}}]),
    ],
    ids=str,
)
def test_a_long_comparison_finds_no_difference(entry_point: str, chosen: list[Any]) -> None:
    config = environment(entry_point, chosen)
    assert compare(config, vectorised(config, 32), steps=10_000, seed=1).difference is None


@pytest.mark.parametrize(
    ("entry_point", "kwargs", "wrapper", "reason"),
    [
        (
            SPREAD,
            {},
            {"frame_stack_v1": {"stack_dim": 0}},
            "wrapper frame_stack_v1 has no vectorised version for its arguments",
        ),
        (SPREAD, {}, "black_death_v3", "wrapper black_death_v3 has no vectorised version"),
        (SPREAD, {}, {"sticky_actions_v0": {"repeat_action_probability": 0.5}}, "wrapper sticky_actions_v0"),
        (SPREAD, {}, "clip_actions_v0", "actions in a Box only"),
        (SPREAD, {}, {"clip_reward_v0": {"lower_bound": 0.5}}, "bounds on both sides of 0"),
        ("pettingzoo.classic.rps_v2", {}, {"frame_stack_v1": {"stack_size": 2}}, "observations in Discrete"),
        ("pettingzoo.classic.connect_four_v3", {}, "pad_action_space_v0", "simultaneous actions only"),
    ],
)
def test_other_wrappers_are_stepped_in_lockstep(
    entry_point: str, kwargs: dict[str, Any], wrapper: Any, reason: str
) -> None:
    found = implementation(environment(entry_point, [wrapper], **kwargs))
    assert found.vector is None
    assert found.reason.startswith("It is stepped in lockstep, because wrapper ")
    assert reason in found.reason
