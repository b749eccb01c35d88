"""The algorithm in this process: it learns what can be learned, and starts anew in the same way."""

from typing import Any

import numpy as np
import pytest
import torch
from ray.rllib.utils.metrics import ENV_RUNNER_RESULTS, EPISODE_MODULE_RETURN_MEAN

from league.config import LeagueConfig
from league.environments.building import interface
from league.errors import ConfigError
from tests.training.environments import ROUNDS
from tests.training.leagues import counting, solvable, tictactoe
from training.algorithms.ppo import PPO, algorithm_config, module_spec
from training.sampling.env_runner import module_spaces

TWO: dict[str, Any] = {"kwargs": {"agents": 2, "opposed": True}, "policies": {"a": ["player_0"], "b": ["player_1"]}}
MEMORY = {"recurrence": {"width": 16, "sequence": 8}}
UPDATES = 40


def built(league: LeagueConfig) -> PPO:
    return algorithm_config(league, interface(league)).build_algo()


def returns(result: dict[str, Any]) -> dict[str, float]:
    return result[ENV_RUNNER_RESULTS].get(EPISODE_MODULE_RETURN_MEAN, {})


def updates_until(league: LeagueConfig, wanted: dict[str, float], most: int = UPDATES) -> int | None:
    """After how many updates each policy's mean return is what is wanted; None if it never is."""
    algorithm = built(league)
    try:
        for update in range(most):
            found = returns(algorithm.train())
            if all(found.get(policy, -np.inf) >= value for policy, value in wanted.items()):
                return update
    finally:
        algorithm.stop()
    return None


@pytest.mark.usefixtures("ray_session")
@pytest.mark.parametrize(
    ("name", "options", "wanted"),
    [
        ("discrete", {}, {"shared": 0.95 * ROUNDS}),
        ("several", {}, {"shared": 0.95 * ROUNDS}),
        ("numbers", {}, {"shared": -0.3}),
        ("far_numbers", {"normalize_observations": True}, {"shared": 0.9 * ROUNDS}),
        ("remembering", MEMORY, {"shared": 0.95}),
        ("discrete", TWO | {"shared_encoder": True}, {"a": 0.95 * ROUNDS, "b": -0.05 * ROUNDS}),
        ("discrete", TWO, {"a": 0.95 * ROUNDS, "b": -0.05 * ROUNDS}),
    ],
    ids=["discrete", "multi-discrete", "box", "normalised", "memory", "shared encoder", "independent"],
)
def test_it_learns(name: str, options: dict[str, Any], wanted: dict[str, float]) -> None:
    assert updates_until(solvable(name, **options), wanted) is not None


@pytest.mark.usefixtures("ray_session")
@pytest.mark.parametrize(
    ("name", "below"), [("far_numbers", 0.7 * ROUNDS), ("remembering", 0.4)], ids=["unnormalised", "memoryless"]
)
def test_what_it_learns_needs_what_was_asked_for(name: str, below: float) -> None:
    assert updates_until(solvable(name), {"shared": below}, most=15) is None


@pytest.mark.usefixtures("ray_session")
def test_phases_follow_the_updates_also_after_a_restore(tmp_path: Any) -> None:
    phases = [{"policies": ["a"], "iterations": 1}, {"policies": ["b"], "iterations": 2}]
    league = solvable("discrete", **TWO, policies_to_train=phases, train_batch_size=128)
    algorithm = built(league)
    try:
        changed = [moved(algorithm) for _ in range(4)]
        algorithm.save_to_path(str(tmp_path / "checkpoint"))
    finally:
        algorithm.stop()
    restored = built(league)
    try:
        restored.restore_from_path(str(tmp_path / "checkpoint"))
        changed += [moved(restored) for _ in range(3)]
    finally:
        restored.stop()
    assert changed == [{"a"}, {"b"}, {"b"}, {"a"}, {"b"}, {"b"}, {"a"}]


def moved(algorithm: PPO) -> set[str]:
    """The policies whose weights an update changes, in the learner and in the runner alike."""

    def weights(modules: Any) -> dict[str, np.ndarray]:
        return {policy: module.get_state()["policy_head.weight"].copy() for policy, module in modules.items()}

    learner, runner = algorithm.learner_group._learner.module, algorithm.env_runner.module
    before = weights(learner)
    algorithm.train()
    after, played = weights(learner), weights(runner)
    assert all(np.array_equal(after[policy], played[policy]) for policy in after)
    return {policy for policy in after if not np.array_equal(before[policy], after[policy])}


@pytest.mark.usefixtures("ray_session")
def test_what_begins_anew_at_the_same_step_goes_on_alike(tmp_path: Any) -> None:
    """One that went on from its checkpoint, and one that was restored from it."""
    league = solvable("remembering", **MEMORY, train_batch_size=128)
    algorithm, weights = built(league), []
    try:
        algorithm.train()
        algorithm.save_to_path(str(tmp_path / "checkpoint"))
        weights.append(after_anew(algorithm))
    finally:
        algorithm.stop()
    torch.manual_seed(77)
    restored = built(league)
    try:
        restored.restore_from_path(str(tmp_path / "checkpoint"))
        weights.append(after_anew(restored))
    finally:
        restored.stop()
    assert weights[0].keys() == weights[1].keys()
    assert all(np.array_equal(value, weights[1][name]) for name, value in weights[0].items())


def after_anew(algorithm: PPO) -> dict[str, np.ndarray]:
    algorithm.begin_anew(128)
    for _ in range(2):
        algorithm.train()
    return algorithm.get_module("shared").get_state()


def test_policies_stand_in_the_order_of_the_agents() -> None:
    """Seeded weights and minibatches are drawn in it: the order of a set differs from process to process."""
    league = solvable("discrete", {"agents": 7}, {f"policy_{i}": [f"player_{6 - i}"] for i in range(7)})
    described = interface(league)
    config = algorithm_config(league, described)
    spaces = {policy: module_spaces(described, policy) for policy in described.policy_ids}
    assert described.policy_ids == tuple(f"policy_{6 - i}" for i in range(7))
    assert tuple(config.get_multi_rl_module_spec(spaces=spaces).build().keys()) == described.policy_ids


def test_policies_that_settings_name_must_exist() -> None:
    for settings in ({"per_policy": {"b": {"lr": 1}}}, {"policies_to_train": ["b"]}):
        league = tictactoe(**settings)
        with pytest.raises(ConfigError, match=r"no such policy|no policy 'b'"):
            algorithm_config(league, interface(league))


def test_spaces_that_do_not_fit_are_refused_with_the_policys_name() -> None:
    league = counting([3], [], convolutions=[{"filters": 4}])
    with pytest.raises(ConfigError, match=r"training\.convolutions: no part of the observation"):
        module_spec(league.training, interface(league)).build()
    league = LeagueConfig.from_mapping(
        {"league": "bits", "environment": {"entry_point": "tests.training.environments:bits"}}
    )
    with pytest.raises(ConfigError, match=r"policies\.shared: no policy has actions of MultiBinary"):
        algorithm_config(league, interface(league))
