"""The reference policies of the magnet. Its term of the loss: `test_ppo_loss.py`."""

from pathlib import Path

import numpy as np
import pytest
import torch

from league.environments.building import interface
from league.errors import ConfigError
from league.policies.onnx import OnnxPolicy
from tests.support.leagues import tictactoe
from tests.support.leagues.training_leagues import solvable
from tests.support.learners import episodes_of, learner_of, update
from training.algorithms.rllib_config import algorithm_config
from training.learners.magnet import Uniform, magnet
from training.learners.ppo import MAGNET_KL, MAGNET_WEIGHT
from training.learners.train_batch import TrainBatch, train_batch
from training.modules.distributions import TorchCategorical
from training.modules.policy_module import MASKED_LOGIT


def test_the_divergence_from_uniform_is_the_missing_entropy_of_legal_actions() -> None:
    legal = torch.tensor([[1, 1, 0], [1, 1, 1]], dtype=torch.bool)
    inputs = torch.where(legal, torch.tensor([[0.3, -1.0, 0.0], [2.0, 0.0, 1.0]]), MASKED_LOGIT)
    batch = TrainBatch({}, *([torch.zeros(2)] * 2), inputs, *([torch.zeros(2)] * 3), None, 0.0)
    kl = TorchCategorical(3).divergence(inputs, Uniform().dist_inputs("shared", batch))
    entropy = TorchCategorical(3).evaluate(inputs, torch.zeros(2, dtype=torch.int64))[1]
    torch.testing.assert_close(kl, torch.tensor([2.0, 3.0]).log() - entropy)


PREVIOUS = {"ref": "previous", "every": 2, "weight": 0.2}


def test_previous_is_refreshed_and_its_divergence_is_reported() -> None:
    league = solvable("discrete", magnet=PREVIOUS)
    learner, episodes = learner_of(league), episodes_of(league)
    snapshots, divergences = [], []
    for _ in range(3):
        divergences.append(update(learner, episodes)["shared"][MAGNET_KL])
        snapshots.append(learner.get_state()["magnet"])
    torch.testing.assert_close(snapshots[0], snapshots[1])
    changed = [not np.array_equal(first, second) for first, second in zip(*map(arrays, snapshots[1:]), strict=True)]
    assert any(changed)
    assert divergences[1] > divergences[0] > 0


def arrays(state: dict[str, dict[str, np.ndarray]]) -> list[np.ndarray]:
    return [array for weights in state.values() for array in weights.values()]


def test_a_restored_learner_has_the_same_snapshot(tmp_path: Path) -> None:
    league = solvable("discrete", magnet=PREVIOUS | {"every": 5})
    learner, episodes = learner_of(league), episodes_of(league)
    update(learner, episodes)
    learner.save_to_path(tmp_path / "state")
    restored = learner_of(league.with_training(seed=8))
    restored.restore_from_path(tmp_path / "state")
    results = []
    for continued in (learner, restored):
        torch.manual_seed(1)
        results.append((update(continued, episodes)["shared"][MAGNET_KL], *arrays(continued.get_state()["magnet"])))
    for first, second in zip(*results, strict=True):
        np.testing.assert_array_equal(first, second)


def test_a_run_that_continues_one_without_a_magnet_starts_from_its_policy(tmp_path: Path) -> None:
    league = solvable("discrete")
    learner, episodes = learner_of(league), episodes_of(league)
    update(learner, episodes)
    learner.save_to_path(tmp_path / "state")
    restored = learner_of(league.with_training(seed=8, magnet=PREVIOUS))
    restored.restore_from_path(tmp_path / "state")
    torch.testing.assert_close(
        restored.get_state()["magnet"], {policy: module.get_state() for policy, module in learner.module.items()}
    )


def test_metrics_contain_the_weight_only_if_it_is_scheduled() -> None:
    league = solvable("discrete", magnet={"ref": "uniform", "weight": {"initial": 0.2, "final": 0.1}})
    episodes = episodes_of(league)
    constant = league.with_training(magnet={"ref": "uniform", "weight": 0.2})
    scheduled, unscheduled, free = (
        update(learner_of(config), episodes)["shared"]
        for config in (league, constant, league.with_training(magnet=None))
    )
    assert scheduled[MAGNET_WEIGHT] == pytest.approx(0.2)
    assert {MAGNET_WEIGHT, MAGNET_KL} & unscheduled.keys() == {MAGNET_KL}
    assert MAGNET_KL not in free


def test_a_strong_magnet_keeps_the_policy_near_the_reference() -> None:
    league = solvable("discrete", magnet={"ref": "uniform", "weight": 0.0})
    divergences = []
    for weight in (0.0, 3.0):
        learner = learner_of(league.with_training(magnet={"ref": "uniform", "weight": weight}))
        torch.manual_seed(0)
        episodes = episodes_of(league)
        for _ in range(5):
            last = update(learner, episodes)["shared"][MAGNET_KL]
        divergences.append(last)
    assert divergences[1] < divergences[0] / 2


def test_a_version_is_a_reference(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In several passes."""
    monkeypatch.setattr("training.learners.magnet.PASS_ROWS", 10)
    registry = tictactoe.registry(tmp_path)
    graph = tictactoe.graph()
    tictactoe.publish(registry, graph)
    league = tictactoe.config().with_training(runners=0, magnet={"ref": "tictactoe@1", "weight": 0.1})
    assert league.training.algorithm == "ppo"
    learner = learner_of(league, storage=registry.storage)
    episodes = episodes_of(league)
    batch = train_batch(learner.module["shared"], episodes, gamma=1.0, lambda_=1.0)
    assert learner._magnet is not None
    dist_inputs = learner._magnet.dist_inputs("shared", batch)
    rows = {name: value[batch.acted].numpy() for name, value in batch.observations.items()}
    assert len(dist_inputs) > 20
    np.testing.assert_allclose(dist_inputs.numpy(), OnnxPolicy(graph).distribution(rows).dist_inputs, rtol=1e-5)
    assert update(learner, episodes)["shared"][MAGNET_KL] > 0


def test_unsuitable_references_are_rejected(tmp_path: Path) -> None:
    league = solvable("numbers", magnet={"ref": "uniform", "weight": 0.1})
    with pytest.raises(ConfigError, match=r"training\.magnet\.ref: uniform needs discrete actions"):
        algorithm_config(league, interface(league))
    league = solvable("discrete").with_training(magnet={"ref": "solvable@1", "weight": 0.1})
    assert league.training.algorithm == "ppo"
    assert league.training.magnet is not None
    learner = learner_of(solvable("discrete"))
    with pytest.raises(ConfigError, match="solvable@1 is a version, but no storage is given"):
        magnet(league.training.magnet, learner.module, interface(league), None)
