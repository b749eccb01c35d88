"""The teacher: its actions, its term of the loss, and resuming."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from league.config.league import LeagueConfig
from league.environments.building import interface
from league.errors import ConfigError, GameCrashed
from league.spaces import ACTION_MASK, OBSERVATION
from tests.support.leagues import tictactoe
from tests.support.leagues.training_leagues import solvable
from tests.support.learners import episodes_of, learner_of, update
from training.algorithms.ppo import algorithm_config
from training.learners.ppo import TEACHER_LOSS, TEACHER_WEIGHT, ppo_loss
from training.learners.teacher import Teacher
from training.learners.train_batch import Minibatch, train_batch
from training.modules.distributions import TorchCategorical, TorchMultiCategorical

pytestmark = pytest.mark.usefixtures("ray_session")


def taught(weight: Any = 1.0, ref: str = "script:first") -> LeagueConfig:
    return tictactoe.config().with_training(runners=0, teacher={"ref": ref, "weight": weight})


def test_the_loss_contains_the_weighted_cross_entropy_of_the_teachers_actions() -> None:
    torch.manual_seed(0)
    inputs, actions = torch.randn(30, 3), torch.randint(3, (30,))
    steps = Minibatch({}, torch.zeros(30, dtype=torch.int64), inputs, torch.zeros(30), *torch.zeros(2, 30))
    options: dict[str, float] = {"clip": 0.2, "entropy": 0.1, "value_loss": 0.5, "teacher": 0.7}
    pulled, free = (
        ppo_loss(each, inputs, torch.zeros(30), TorchCategorical(3), **options)
        for each in (replace(steps, taught=actions), steps)
    )
    expected = torch.nn.functional.cross_entropy(inputs, actions)
    assert pulled.teacher.item() == pytest.approx(expected.item(), rel=1e-5)
    assert (pulled.total - free.total).item() == pytest.approx(0.7 * expected.item(), rel=1e-4)
    assert free.teacher == 0


def test_the_teacher_acts_on_the_observations_of_the_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    """In several passes."""
    monkeypatch.setattr("training.learners.teacher.PASS_ROWS", 10)
    league = taught()
    learner, episodes = learner_of(league), episodes_of(league)
    batch = train_batch(learner.module["shared"], episodes, gamma=1.0, lambda_=1.0)
    assert league.training.algorithm == "ppo"
    assert league.training.teacher is not None
    found = Teacher(league.training.teacher, interface(league), None, 0).actions("shared", batch, 1)
    masks = batch.observations[ACTION_MASK][batch.acted].numpy()
    assert len(masks) > 20
    np.testing.assert_array_equal(found.numpy(), masks.argmax(axis=1))
    assert OBSERVATION in batch.observations


def test_raw_actions_of_a_multi_discrete_space_start_at_zero() -> None:
    league = solvable("several", teacher={"ref": "script:first", "weight": 1.0})
    learner, episodes = learner_of(league), episodes_of(league)
    (policy,) = learner.module.keys()
    batch = train_batch(learner.module[policy], episodes, gamma=1.0, lambda_=1.0)
    assert learner._teacher is not None
    found = learner._teacher.actions(policy, batch, 1)
    assert isinstance(learner.module[policy].distribution, TorchMultiCategorical)
    assert found.shape == batch.actions.shape
    assert not found.any()


def test_the_policy_imitates_the_teacher() -> None:
    league = taught(weight=3.0).with_training(lr=0.01, opening_plies=0)  # openings are not learned
    learner, episodes = learner_of(league), episodes_of(league)
    losses = [update(learner, episodes)[TEACHER_LOSS] for _ in range(25)]
    assert losses[-1] < losses[0] / 2


def test_the_teacher_is_not_asked_once_its_weight_is_zero() -> None:
    episodes = episodes_of(taught())
    scheduled = update(learner_of(taught(weight={"initial": 0.5, "final": 0.0})), episodes)
    assert scheduled[TEACHER_WEIGHT] == pytest.approx(0.5)
    constant = update(learner_of(taught(weight=0.5)), episodes)
    assert TEACHER_WEIGHT not in constant
    assert TEACHER_LOSS in constant
    assert TEACHER_LOSS not in update(learner_of(taught(weight=0.0)), episodes)


def test_a_restored_learner_sees_the_same_actions(tmp_path: Path) -> None:
    league = taught(ref="script:random")
    learner, episodes = learner_of(league), episodes_of(league)
    update(learner, episodes)
    learner.save_to_path(tmp_path / "state")
    restored = learner_of(league)
    restored.restore_from_path(tmp_path / "state")
    losses = []
    for each in (learner, restored):
        torch.manual_seed(1)
        losses.append(update(each, episodes)[TEACHER_LOSS])
    assert losses[0] == pytest.approx(losses[1], rel=1e-6)


def test_unsuitable_teachers_are_rejected() -> None:
    league = solvable("numbers", teacher={"ref": "script:first", "weight": 0.1})
    with pytest.raises(ConfigError, match=r"training\.teacher needs discrete actions"):
        algorithm_config(league, interface(league))
    with pytest.raises(ConfigError, match="tictactoe@1 is a version, but no storage is given"):
        learner_of(taught(ref="tictactoe@1"))


def test_an_exception_of_the_teacher_ends_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "broken_teacher.py").write_text("def act(observation, action_mask, rng):\n    raise KeyError('plan')\n")
    monkeypatch.syspath_prepend(tmp_path)
    league = taught(ref="script:broken_teacher:act")
    learner, episodes = learner_of(league), episodes_of(league)
    batch = train_batch(learner.module["shared"], episodes, gamma=1.0, lambda_=1.0)
    assert league.training.algorithm == "ppo"
    assert league.training.teacher is not None
    teacher = Teacher(league.training.teacher, interface(league), None, 0)
    with pytest.raises(GameCrashed, match=r"training\.teacher: script:broken_teacher:act: KeyError: 'plan'"):
        teacher.actions("shared", batch, 1)
