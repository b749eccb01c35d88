"""The learner alone, on episodes sampled by a runner in this process."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from ray.rllib.utils.metrics import ALL_MODULES

from league.config.league import LeagueConfig
from league.config.schedules import ScheduleProgress
from league.errors import ConfigError
from tests.support.leagues.training_leagues import solvable, tictactoe
from tests.support.learners import episodes_of, equal, learner_of, update, weights
from training.learners import ppo
from training.learners.train_batch import train_batch
from training.sampling.episode_chunks import EpisodeChunks

TWO: dict[str, Any] = {"kwargs": {"agents": 2}, "policies": {"a": ["player_0"], "b": ["player_1"]}}


@pytest.fixture(scope="module")
def two() -> tuple[LeagueConfig, list[EpisodeChunks]]:
    league = solvable("discrete", **TWO)
    return league, episodes_of(league)


def test_an_update_changes_every_policy_and_reports_metrics(two: tuple) -> None:
    learner = learner_of(two[0])
    before = weights(learner)
    metrics = update(learner, two[1])
    after = weights(learner)
    for policy in ("a", "b"):
        assert not equal(before[policy], after[policy])
        logged = metrics[policy]
        assert {*ppo.STATISTICS, ppo.EXPLAINED_VARIANCE, ppo.KL} <= logged.keys()
        assert np.isfinite([*logged.values()]).all()
        assert 0 < logged["kl"] < 0.5
        assert logged["gradient_norm"] > 0
        assert 0 < logged["entropy"] <= np.log(3)


@pytest.mark.parametrize("training", [{}, {"normalize_observations": True}], ids=["plain", "normalised"])
def test_a_frozen_policy_keeps_weights_and_optimizer(training: dict[str, Any]) -> None:
    league = solvable("far_numbers", kwargs={"agents": 2}, policies=TWO["policies"], **training)
    learner, episodes = learner_of(league), episodes_of(league)
    update(learner, episodes)
    before, optimizers = weights(learner), learner._get_optimizer_state()
    metrics = update(learner, episodes, policies=("b",))
    after, moved = weights(learner), learner._get_optimizer_state()
    assert equal(before["a"], after["a"])
    assert equal(optimizers["a_default_optimizer"], moved["a_default_optimizer"])
    assert not equal(before["b"], after["b"])
    assert not equal(optimizers["b_default_optimizer"], moved["b_default_optimizer"])
    assert set(metrics) == {"b"}
    assert update(learner, episodes, policies=()) == {}
    assert equal(after, weights(learner))


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("discrete", TWO | {"shared_encoder": True}),
        ("far_numbers", {"normalize_observations": True}),
        ("remembering", {"recurrence": {"width": 8, "sequence": 2}}),
        ("numbers", {}),
        ("watching", {"policies": TWO["policies"], "critic": "central", "normalize_values": True}),
    ],
)
def test_a_restored_learner_continues_identically(name: str, options: dict[str, Any], tmp_path: Path) -> None:
    league = solvable(name, **options)
    first, second = episodes_of(league), episodes_of(league.with_training(seed=9))
    learner = learner_of(league)
    update(learner, first)
    learner.save_to_path(tmp_path / "state")
    torch.manual_seed(1)
    update(learner, second)

    restored = learner_of(league.with_training(seed=8))
    restored.restore_from_path(tmp_path / "state")
    torch.manual_seed(1)
    update(restored, second)
    assert equal(weights(learner), weights(restored))
    assert equal(learner._get_optimizer_state(), restored._get_optimizer_state())


def test_each_policy_learns_with_its_own_settings(two: tuple, monkeypatch: pytest.MonkeyPatch) -> None:
    per_policy = {"b": {"lr": 0.5, "gamma": 0.1, "lambda": 0.2, "clip": 0.4, "entropy": 0.6}}
    league = two[0].with_training(per_policy=per_policy)
    learner = learner_of(league)
    used: dict[str, Any] = {}

    def batch(module: Any, chunks: Any, **options: Any) -> Any:
        used[chunks[0].policy] = (options["gamma"], options["lambda_"])
        return train_batch(module, chunks, **options)

    def loss(steps: Any, *arguments: Any, **options: Any) -> Any:
        used[f"loss {arguments[2] is learner.module['b'].distribution}"] = (options["clip"], options["entropy"])
        return original(steps, *arguments, **options)

    original = ppo.ppo_loss
    monkeypatch.setattr(ppo, "train_batch", batch)
    monkeypatch.setattr(ppo, "ppo_loss", loss)
    update(learner, two[1])
    settings = league.training
    assert used["a"] == (settings.gamma, settings.lambda_)
    assert used["b"] == (0.1, 0.2)
    assert used["loss False"] == (settings.clip, settings.entropy)
    assert used["loss True"] == (0.4, 0.6)
    rates = {name: optimizer.param_groups[0]["lr"] for name, optimizer in learner._named_optimizers.items()}
    assert rates == {"a_default_optimizer": settings.lr, "b_default_optimizer": 0.5}


@pytest.mark.parametrize("shared_encoder", [False, True], ids=["separate", "shared encoder"])
def test_schedules_hold_in_each_update_and_are_logged(shared_encoder: bool) -> None:
    per_policy = {"b": {"lr": 0.5, "entropy": [[0, 0.2], [1000, 0.1]]}}
    league = solvable(
        "discrete", **TWO, shared_encoder=shared_encoder, lr={"initial": 0.01, "final": 0}, per_policy=per_policy
    )
    learner, episodes = learner_of(league), episodes_of(league)
    metrics = update(learner, episodes, progress=ScheduleProgress(steps=500, budget=0.75))
    rates = {name: optimizer.param_groups[0]["lr"] for name, optimizer in learner._named_optimizers.items()}
    expected = {"a_default_optimizer": 0.0025, "b_default_optimizer": 0.5}
    if shared_encoder:
        expected |= {f"{ALL_MODULES}_default_optimizer": 0.0025}
    assert rates == pytest.approx(expected)
    assert (metrics["a"]["lr"], metrics["b"]["entropy_coefficient"]) == pytest.approx((0.0025, 0.15))
    assert not {"clip", "entropy_coefficient"} & metrics["a"].keys(), "constants are not logged"
    assert "lr" not in metrics["b"]


def test_a_learning_rate_of_zero_keeps_the_weights(two: tuple) -> None:
    learner = learner_of(two[0].with_training(lr={"initial": 0.01, "final": 0}))
    before = weights(learner)
    update(learner, two[1], progress=ScheduleProgress(steps=0, budget=1.0))
    assert equal(before, weights(learner))
    update(learner, two[1], progress=ScheduleProgress(steps=0, budget=0.9))
    assert not equal(before, weights(learner))


def test_a_shared_encoder_has_one_optimizer_for_the_losses_of_all_policies(two: tuple) -> None:
    league = two[0].with_training(shared_encoder=True)
    learner = learner_of(league)
    names = list(learner._named_optimizers)
    assert names == ["a_default_optimizer", "b_default_optimizer", f"{ALL_MODULES}_default_optimizer"]
    parameters = [set(map(id, optimizer.param_groups[0]["params"])) for optimizer in learner._named_optimizers.values()]
    assert sum(map(len, parameters)) == len(set.union(*parameters))
    assert parameters[2] == set(map(id, learner.module.encoder.parameters()))
    before = learner.module.encoder.hidden[0].weight.detach().clone()
    update(learner, [chunks for chunks in two[1] if chunks.policy == "b"])
    assert not torch.equal(before, learner.module.encoder.hidden[0].weight)


def test_a_gradient_that_is_not_finite_is_dropped(two: tuple, caplog: pytest.LogCaptureFixture) -> None:
    learner = learner_of(two[0])
    update(learner, two[1])
    with torch.no_grad():
        learner.module["a"].value_head.bias.fill_(1e30)
    before = weights(learner)
    update(learner, two[1])
    after = weights(learner)
    assert equal(before["a"], after["a"])
    assert not equal(before["b"], after["b"])
    assert "Dropped a non-finite gradient of a" in caplog.text


def test_a_missing_gpu_is_rejected(two: tuple) -> None:
    if torch.cuda.is_available():
        pytest.skip("a GPU is present")
    with pytest.raises(ConfigError, match=r"training\.gpus: 0\.5 requested for the learner, but torch finds no GPU"):
        learner_of(two[0].with_training(gpus=0.5))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_gpu_learns_like_the_cpu(two: tuple) -> None:
    torch.manual_seed(0)
    learners = [learner_of(two[0].with_training(gpus=gpus)) for gpus in (0, 1)]
    for policy, module in learners[1].module.items():
        module.set_state(learners[0].module[policy].get_state())
    for learner in learners:
        torch.manual_seed(1)
        update(learner, two[1])
    for policy, state in weights(learners[0]).items():
        for name, value in state.items():
            np.testing.assert_allclose(weights(learners[1])[policy][name], value, atol=1e-4)


def test_the_policy_imitates_the_teacher() -> None:
    league = tictactoe(teacher={"ref": "script:first", "weight": 3.0}, lr=0.01)
    learner, episodes = learner_of(league), episodes_of(league, taught=("shared",))
    losses = [update(learner, episodes)["shared"][ppo.TEACHER_LOSS] for _ in range(25)]
    assert losses[-1] < losses[0] / 2
