"""PPO as an algorithm: it learns, with its runners. That it continues identically: `runs/test_trial.py`."""

from typing import Any

import numpy as np
import pytest
import ray
import torch
from ray.exceptions import RayActorError
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.core.columns import Columns
from ray.rllib.utils.metrics import (
    ENV_RUNNER_RESULTS,
    EPISODE_MODULE_RETURN_MEAN,
    LEARNER_RESULTS,
    NUM_ENV_STEPS_SAMPLED,
)

from league.config.league import LeagueConfig
from league.config.schedules import ScheduleProgress
from league.environments.building import interface
from league.errors import ConfigError
from tests.support.algorithms import running
from tests.support.closeness import close
from tests.support.environments.training_environments import ROUNDS
from tests.support.leagues.training_leagues import counting, solvable, tictactoe
from tests.support.learners import equal, weights
from tests.support.waiting import until
from training.algorithms.ppo import PPO
from training.algorithms.rllib_config import algorithm_config, module_spec
from training.learners.ppo import TEACHER_LOSS, TEACHER_WEIGHT
from training.rllib_compat import local_learner
from training.runs.error_messages import is_process_lost
from training.sampling.env_runner import module_spaces
from training.sampling.episode_chunks import EpisodeChunks

TWO: dict[str, Any] = {"kwargs": {"agents": 2, "opposed": True}, "policies": {"a": ["player_0"], "b": ["player_1"]}}
MEMORY = {"recurrence": {"width": 16, "sequence": 8}}
SMALL: dict[str, Any] = {"train_batch_size": 64, "minibatch_size": 64, "epochs": 1}


def learns(league: LeagueConfig, target: dict[str, float], limit: int) -> bool:
    """Whether the mean return of each policy reaches its target within a number of updates."""
    with running(league) as algorithm:
        for _ in range(limit):
            means = algorithm.train()[ENV_RUNNER_RESULTS].get(EPISODE_MODULE_RETURN_MEAN, {})
            if all(means.get(policy, -np.inf) >= value for policy, value in target.items()):
                return True
    return False


@pytest.mark.usefixtures("ray_session")
@pytest.mark.parametrize(
    ("name", "options", "target"),
    [
        pytest.param("discrete", {}, {"shared": 0.95 * ROUNDS}, marks=pytest.mark.slow),
        pytest.param("several", {}, {"shared": 0.95 * ROUNDS}, marks=pytest.mark.slow),
        pytest.param("numbers", {}, {"shared": -0.3}, marks=pytest.mark.slow),
        ("far_numbers", {"normalize_observations": True}, {"shared": 0.9 * ROUNDS}),
        pytest.param("remembering", MEMORY, {"shared": 0.95}, marks=pytest.mark.slow),
        pytest.param(
            "discrete",
            TWO | {"shared_encoder": True},
            {"a": 0.95 * ROUNDS, "b": -0.05 * ROUNDS},
            marks=pytest.mark.slow,
        ),
        pytest.param("discrete", TWO, {"a": 0.95 * ROUNDS, "b": -0.05 * ROUNDS}, marks=pytest.mark.slow),
    ],
    ids=["discrete", "multi-discrete", "box", "normalised", "memory", "shared encoder", "independent"],
)
def test_ppo_learns(name: str, options: dict[str, Any], target: dict[str, float]) -> None:
    assert learns(solvable(name, **options), target, limit=40)


@pytest.mark.slow
@pytest.mark.usefixtures("ray_session")
@pytest.mark.parametrize(
    ("name", "below"), [("far_numbers", 0.7 * ROUNDS), ("remembering", 0.4)], ids=["unnormalised", "memoryless"]
)
def test_it_does_not_learn_without_the_required_setting(name: str, below: float) -> None:
    assert not learns(solvable(name), {"shared": below}, limit=15)


@pytest.mark.slow
@pytest.mark.usefixtures("ray_session")
def test_a_slow_runner_is_waited_for_and_a_lost_one_ends_training() -> None:
    league = tictactoe(runners=1, **SMALL)
    config = algorithm_config(league, interface(league)).env_runners(sample_timeout_s=0.001)  # RLlib's: one minute
    algorithm = config.build_algo()
    try:
        assert algorithm.train()[ENV_RUNNER_RESULTS][NUM_ENV_STEPS_SAMPLED] >= 64
        (runner,) = algorithm.env_runner_group._worker_manager._actors.values()
        algorithm.reset_episodes(64)
        ray.kill(runner)
        with pytest.raises(RayActorError):
            algorithm.train()
    finally:
        algorithm.stop()


def is_lost(runner: Any) -> bool:
    try:
        ray.get(runner.ping.remote())
    except RayActorError:
        return True
    return False


@pytest.mark.slow
@pytest.mark.usefixtures("ray_session")
def test_a_runner_lost_before_a_checkpoint_ends_training() -> None:
    """Its sample in flight is not needed, but the runner is."""
    with running(tictactoe(runners=1, **SMALL)) as algorithm:
        algorithm.train()
        (runner,) = algorithm.env_runner_group._worker_manager._actors.values()
        ray.kill(runner)
        until(lambda: is_lost(runner))  # it may answer for a moment
        with pytest.raises(RayActorError):
            algorithm.reset_episodes(64)


@pytest.mark.slow
@pytest.mark.usefixtures("ray_session")
def test_a_further_learner_repeats_updates_and_a_lost_one_ends_training() -> None:
    """Their processes, on CPUs, where `league train` refuses several learners."""
    league = tictactoe(runners=0, **SMALL | {"train_batch_size": 256})
    with running(league) as alone:
        alone.train()
        expected = weights(local_learner(alone))
    with running(league.with_training(learners=2)) as algorithm:
        before = weights(first := local_learner(algorithm))
        algorithm.train()
        assert close(weights(first)["shared"], expected["shared"], 1e-3)
        assert not close(weights(first)["shared"], before["shared"], 1e-3)
        algorithm.train()
        (repeated,) = algorithm.further_learners.apply(lambda further: weights(further._learner))
        assert equal(repeated, weights(first))
        (process,) = algorithm.further_learners._actors
        ray.kill(process)
        with pytest.raises(RayActorError) as lost:
            algorithm.train()
        assert is_process_lost(lost.value)


class Recording(PPO):
    """Keeps each update's sample, and the weights before the first update and after each."""

    def setup(self, config: AlgorithmConfig) -> None:
        super().setup(config)
        self.samples: list[list[EpisodeChunks]] = []
        self.weights = [self.get_module("shared").get_state()]

    def sample_train_batch(self) -> tuple[list[EpisodeChunks], list[dict[str, Any]]]:
        chunks, metrics = super().sample_train_batch()
        self.samples.append(chunks)
        return chunks, metrics

    def training_step(self) -> None:
        super().training_step()
        self.weights.append(self.get_module("shared").get_state())


def recorded(league: LeagueConfig, updates: int) -> Recording:
    algorithm = Recording(config=algorithm_config(league, interface(league)))
    try:
        algorithm.reset_episodes(0)
        for _ in range(updates):
            algorithm.train()
    finally:
        algorithm.stop()
    return algorithm


@pytest.mark.usefixtures("ray_session")
@pytest.mark.parametrize(
    ("lag", "runners", "effective"),
    [
        pytest.param(0, 2, 0, marks=pytest.mark.slow),
        pytest.param(1, 2, 1, marks=pytest.mark.slow),
        pytest.param(2, 1, 2, marks=pytest.mark.slow),
        (1, 0, 0),
    ],
)
def test_a_sample_is_from_the_weights_of_a_fixed_earlier_update(lag: int, runners: int, effective: int) -> None:
    """Except for actions whose results the sample before did not contain."""
    algorithm = recorded(tictactoe(runners=runners, lag=lag, **SMALL), updates=5)
    module = algorithm.config.get_multi_rl_module_spec(spaces=algorithm.spaces).build()["shared"]

    def difference(weights: dict[str, np.ndarray], chunks: EpisodeChunks) -> float:
        module.set_state(weights)
        acted = np.delete(np.arange(len(chunks.actions) + len(chunks.lengths)), np.cumsum(chunks.lengths + 1) - 1)
        observations = {name: torch.from_numpy(value[acted]) for name, value in chunks.observations.items()}
        outputs = module.forward_inference({Columns.OBS: observations})[Columns.ACTION_DIST_INPUTS]
        return float(np.median(np.abs(outputs.detach().numpy() - chunks.dist_inputs)))

    for update, sample in enumerate(algorithm.samples):
        for chunks in sample:
            differences = [difference(weights, chunks) for weights in algorithm.weights]
            assert np.argmin(differences) == max(update - effective, 0)
            assert min(differences) < 1e-6 < np.partition(differences, 1)[1]


@pytest.mark.slow
@pytest.mark.usefixtures("ray_session")
@pytest.mark.parametrize("critic", ["own", "central"])
def test_equal_seeds_give_equal_weights_while_runners_and_learner_overlap(critic: str) -> None:
    first, second = (recorded(tictactoe(runners=2, critic=critic, **SMALL), updates=4) for _ in range(2))
    for one, other in zip(first.weights, second.weights, strict=True):
        assert all(np.array_equal(value, other[name]) for name, value in one.items())
    assert any(not np.array_equal(value, first.weights[-1][name]) for name, value in first.weights[0].items())


@pytest.mark.usefixtures("ray_session")
def test_phases_follow_the_updates_after_restoring(tmp_path: Any) -> None:
    phases = [{"policies": ["a"], "iterations": 1}, {"policies": ["b"], "iterations": 2}]
    league = solvable("discrete", **TWO, policies_to_train=phases, train_batch_size=128)
    with running(league) as algorithm:
        changed = [changed_policies(algorithm) for _ in range(4)]
        algorithm.save_to_path(str(tmp_path / "checkpoint"))
    with running(league, tmp_path / "checkpoint") as restored:
        changed += [changed_policies(restored) for _ in range(3)]
    assert changed == [{"a"}, {"b"}, {"b"}, {"a"}, {"b"}, {"b"}, {"a"}]


@pytest.mark.slow
@pytest.mark.usefixtures("ray_session")
def test_the_teacher_acts_in_all_runners_while_its_weight_is_not_zero() -> None:
    """And only on the steps of policies that learn."""
    weight = {"initial": 0.5, "final": 0.0, "steps": 100}
    settings = {"teacher": {"ref": "script:first", "weight": weight}, "policies_to_train": ["b"], "runners": 2}
    league = solvable("discrete", **TWO, **settings, train_batch_size=256)
    with running(league) as algorithm:
        chunks, _ = algorithm.sample_train_batch()
        runners = {(part.name.split("-")[0], part.policy): part.taught is not None for part in chunks}
        assert runners == {("0", "a"): False, ("0", "b"): True, ("1", "a"): False, ("1", "b"): True}
        results = []
        for steps in (50, 100):
            algorithm.progress = ScheduleProgress(steps, 0.0)
            results.append(algorithm.train()[LEARNER_RESULTS]["b"])
    assert [result[TEACHER_WEIGHT] for result in results] == pytest.approx([0.25, 0])
    assert [np.isfinite(result.get(TEACHER_LOSS, np.nan)) for result in results] == [True, False]


def changed_policies(algorithm: PPO) -> set[str]:
    """The policies whose weights change in an update, which must be the same in the learner and in the runner."""

    def weights(modules: Any) -> dict[str, np.ndarray]:
        return {policy: module.get_state()["policy_head.weight"].copy() for policy, module in modules.items()}

    learner, runner = algorithm.learner_group._learner.module, algorithm.env_runner.module
    before = weights(learner)
    algorithm.train()
    after, played = weights(learner), weights(runner)
    assert all(np.array_equal(after[policy], played[policy]) for policy in after)
    return {policy for policy in after if not np.array_equal(before[policy], after[policy])}


def test_policies_are_in_the_order_of_the_agents() -> None:
    """Seeded weights and minibatches are drawn in this order; that of a set differs between processes."""
    league = solvable("discrete", {"agents": 7}, {f"policy_{i}": [f"player_{6 - i}"] for i in range(7)})
    interface_of_league = interface(league)
    config = algorithm_config(league, interface_of_league)
    spaces = {policy: module_spaces(interface_of_league, policy) for policy in interface_of_league.policy_ids}
    assert interface_of_league.policy_ids == tuple(f"policy_{6 - i}" for i in range(7))
    assert tuple(config.get_multi_rl_module_spec(spaces=spaces).build().keys()) == interface_of_league.policy_ids


def test_a_central_critic_of_a_single_agent_is_rejected() -> None:
    league = solvable("discrete", critic="central")
    with pytest.raises(ConfigError, match=r"training\.critic: central needs several agents"):
        algorithm_config(league, interface(league))


def test_unsupported_spaces_are_rejected_with_the_name_of_the_policy() -> None:
    league = counting([3], [], convolutions=[{"filters": 4}])
    with pytest.raises(ConfigError, match=r"training\.convolutions: no part of the observation"):
        module_spec(league.training, interface(league)).build()
    league = LeagueConfig.from_mapping(
        {"league": "bits", "environment": {"entry_point": "tests.support.environments.training_environments:bits"}}
    )
    with pytest.raises(ConfigError, match=r"policies\.shared: unsupported action space MultiBinary"):
        algorithm_config(league, interface(league))
