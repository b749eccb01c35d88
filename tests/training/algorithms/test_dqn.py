"""DQN in this process: it learns what can be learned, with each of its parts, and goes on exactly where it was."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from ray.rllib.utils.metrics import ENV_RUNNER_RESULTS, EPISODE_MODULE_RETURN_MEAN

from league.config import LeagueConfig
from league.environments.building import interface
from league.errors import ConfigError
from league.policies.onnx import OnnxPolicy
from tests.training.environments import ROUNDS
from tests.training.leagues import by_values, solvable
from training import parity
from training.algorithms.dispatch import algorithm_config, module_spec
from training.algorithms.off_policy import OffPolicy
from training.export import export_policy
from training.learners import dqn as learning
from training.learners.q_targets import next_actions
from training.modules.acting import MASKED
from training.sampling.closed import TERMINATED, TRUNCATED, OwnTransitions

pytestmark = pytest.mark.usefixtures("ray_session")
RETURN = 1 / (1 - 0.9)
EVERYTHING = {"n_step": 3, "priorities": {}, "noisy": True, "distributional": {"low": -1, "high": 5}}


def built(league: LeagueConfig) -> OffPolicy:
    algorithm = algorithm_config(league, interface(league)).build_algo()
    algorithm.begin_anew(0)
    return algorithm


def trained(league: LeagueConfig, updates: int, look: Callable[[OffPolicy, dict[str, Any]], Any]) -> Any:
    algorithm = built(league)
    try:
        for _ in range(updates):
            result = algorithm.train()
        return look(algorithm, result)
    finally:
        algorithm.stop()


def returns(_: OffPolicy, result: dict[str, Any]) -> dict[str, float]:
    return result[ENV_RUNNER_RESULTS][EPISODE_MODULE_RETURN_MEAN]


@pytest.mark.parametrize(
    "settings",
    [{}, {"double": False, "dueling": False}, EVERYTHING, {"target_every": 1, "target_rate": 0.02}],
    ids=["plain", "single", "all parts", "Polyak"],
)
def test_it_learns(settings: dict[str, Any]) -> None:
    assert trained(by_values("discrete", **settings), 9, returns)["shared"] > 0.9 * ROUNDS


def test_independent_policies_learn_each_its_own() -> None:
    league = by_values("discrete", {"agents": 2, "opposed": True}, {"a": ["player_0"], "b": ["player_1"]})
    found = trained(league, 10, returns)
    assert found["a"] > 0.85 * ROUNDS
    assert found["b"] > -0.15 * ROUNDS


def values_of(algorithm: OffPolicy, _: Any) -> NDArray:
    """What the only state is worth by each action, masked."""
    module = algorithm.learner_group._learner.module["shared"]
    seen = {"observation": torch.ones(1, 1), "action_mask": torch.tensor([[1, 0, 1]])}
    return module.forward_inference({"obs": seen})["action_dist_inputs"].numpy()[0]


def check_values(n_step: int = 1) -> None:
    """An agent that is truncated could have gone on: the state is worth what it is worth for ever, and an illegal
    action that seems to be worth a million counts for nothing."""
    league = by_values("masked", gamma=0.9, n_step=n_step, exploration={"initial": 0.5, "final": 0.5})

    def look(algorithm: OffPolicy, _: Any) -> NDArray:
        learner = algorithm.learner_group._learner
        for network in (learner.module["shared"], learner.targets["shared"]):
            with torch.no_grad():
                network.advantages.bias[1] += 1000.0
        for _ in range(8):
            result = algorithm.train()
        return values_of(algorithm, result)

    found = trained(league, 1, look)
    assert found[1] == MASKED
    np.testing.assert_allclose(found[[0, 2]], RETURN, rtol=0.1)


@pytest.mark.parametrize("n_step", [1, 3])
def test_values_are_those_of_legal_play_that_goes_on(n_step: int) -> None:
    check_values(n_step)


def test_the_check_sees_truncation_taken_for_termination(monkeypatch: pytest.MonkeyPatch) -> None:
    cut = OwnTransitions.cut

    def as_terminated(self: OwnTransitions) -> Any:
        blocks = cut(self)
        for block in blocks.values():
            block.rows[TERMINATED] = block.rows[TERMINATED] | block.rows[TRUNCATED]
        return blocks

    monkeypatch.setattr(OwnTransitions, "cut", as_terminated)
    with pytest.raises(AssertionError):
        check_values()


def test_the_check_sees_targets_without_a_mask(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learning, "next_actions", lambda online, target, _: next_actions(online, target, None))
    with pytest.raises(AssertionError):
        check_values()


def test_what_begins_anew_at_the_same_step_goes_on_alike(tmp_path: Path) -> None:
    """One that went on from its checkpoint, and one that was restored from it: weights, targets, and what is kept."""
    league = by_values("discrete", **EVERYTHING, replay_capacity=900)

    def after(algorithm: OffPolicy) -> list[NDArray]:
        algorithm.begin_anew(2048)
        for _ in range(2):
            algorithm.train()
        learner = algorithm.learner_group._learner
        states = [learner.module["shared"].state_dict(), learner.targets["shared"].state_dict()]
        kept = algorithm.replays["shared"].sample(64).rows.values()
        return [tensor.numpy().copy() for state in states for tensor in state.values()] + list(kept)

    def save(algorithm: OffPolicy, _: Any) -> list[NDArray]:
        algorithm.save_to_path(str(tmp_path / "checkpoint"))
        return after(algorithm)

    expected = trained(league, 2, save)
    torch.manual_seed(77)
    restored = built(league)
    try:
        restored.restore_from_path(str(tmp_path / "checkpoint"))
        found = after(restored)
    finally:
        restored.stop()
    for before, now in zip(expected, found, strict=True):
        np.testing.assert_array_equal(before, now)


def test_a_buffer_that_is_left_out_begins_empty(tmp_path: Path) -> None:
    league = by_values("discrete", replay_in_checkpoint=False)
    trained(league, 1, lambda algorithm, _: algorithm.save_to_path(str(tmp_path / "checkpoint")))
    restored = built(league)
    try:
        restored.restore_from_path(str(tmp_path / "checkpoint"))
        assert (len(restored.replays["shared"]), restored.steps) == (0, 1024)
    finally:
        restored.stop()


def test_a_buffer_of_another_capacity_is_refused(tmp_path: Path) -> None:
    league = by_values("discrete")
    trained(league, 1, lambda algorithm, _: algorithm.save_to_path(str(tmp_path / "checkpoint")))
    restored = built(league.with_training(replay_capacity=5000))
    try:
        with pytest.raises(
            ConfigError, match=r"training\.replay_capacity: the checkpoint's buffer has 100000, got 5000"
        ):
            restored.restore_from_path(str(tmp_path / "checkpoint"))
    finally:
        restored.stop()


def test_exploration_and_priorities_follow_their_schedules() -> None:
    league = by_values("discrete", steps=4096, priorities={"beta": 0.4}, exploration={"steps": 2048, "final": 0.1})

    def look(algorithm: OffPolicy, result: dict[str, Any]) -> tuple[float, float, float]:
        return algorithm.steps, result["exploration"], algorithm._beta

    assert trained(league, 1, look) == (1024, pytest.approx(0.55), pytest.approx(0.55))
    assert trained(league, 3, look) == (3072, pytest.approx(0.1), pytest.approx(0.85))


@pytest.mark.parametrize("settings", [{}, EVERYTHING], ids=["plain", "all parts"])
def test_the_graph_acts_as_the_module_does_without_its_noise(settings: dict[str, Any], tmp_path: Path) -> None:
    league = by_values("masked", **settings)
    described = interface(league)
    module = module_spec(league.training, described).build()["shared"]
    export_policy(module, described.of_policy("shared"), tmp_path / "shared.onnx")
    met = parity.gather(league.environment, described, {"shared": module}, seed=1)["shared"]
    proof = parity.prove(tmp_path / "shared.onnx", "shared", module, met, described.of_policy("shared").action)
    assert (proof.mismatches, proof.max_difference < 1e-5) == (0, True)
    graph = OnnxPolicy(tmp_path / "shared.onnx").distribution(met[0].observations)
    assert (graph.dist_inputs[:, 1] == np.float32(MASKED)).all()
    assert (graph.actions != 1).all()


def test_actions_that_have_no_values_are_refused_with_what_to_do() -> None:
    league = solvable("numbers")
    with pytest.raises(ConfigError, match=r"policies\.shared: dqn needs Discrete actions, got .*: train it with"):
        algorithm_config(by_values("numbers"), interface(league))
