"""The teacher in the runners: its actions, and errors."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from league.config.league import LeagueConfig
from league.environments.building import interface
from league.errors import ConfigError, GameCrashed, LeagueError
from league.spaces import ACTION_MASK
from tests.support.algorithms import running
from tests.support.leagues import tictactoe
from tests.support.leagues.training_leagues import counting, solvable
from tests.support.learners import episodes_of
from tests.support.policies.bots import MODULE
from training.algorithms.rllib_config import algorithm_config
from training.runs.error_messages import training_error
from training.sampling.env_runner import BatchedEnvRunner
from training.sampling.teacher import Teacher

pytestmark = pytest.mark.usefixtures("ray_session")


def with_teacher(ref: str, **training: Any) -> LeagueConfig:
    settings: dict[str, Any] = {"runners": 0, "teacher": {"ref": ref, "weight": 1.0}}
    return tictactoe.config().with_training(**settings | training)


def teacher_of(league: LeagueConfig) -> Teacher:
    assert league.training.algorithm == "ppo"
    assert league.training.teacher is not None
    return Teacher(league.training.teacher, interface(league), None, league.training.seed)


def test_the_teacher_acts_on_the_observations_of_the_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """In several passes."""
    monkeypatch.setattr("training.sampling.teacher.PASS_ROWS", 10)
    league = with_teacher("script:first")
    (chunks,) = episodes_of(league)
    stops = np.cumsum(chunks.lengths + 1)
    masks = [
        chunks.observations[ACTION_MASK][stop - length - 1 : stop - 1]
        for stop, length in zip(stops, chunks.lengths, strict=True)
    ]
    expected = np.concatenate(masks).argmax(axis=1)
    assert len(expected) > 20
    np.testing.assert_array_equal(teacher_of(league).actions(chunks), expected)


def test_raw_actions_of_a_multi_discrete_space_start_at_zero() -> None:
    league = solvable("several", teacher={"ref": "script:first", "weight": 1.0})
    (chunks,) = episodes_of(league)
    actions = teacher_of(league).actions(chunks)
    assert actions.shape == chunks.actions.shape == (len(actions), 2)
    assert not actions.any()


def test_the_teacher_acts_only_on_the_recorded_steps_of_the_policies_that_it_teaches() -> None:
    teacher = {"ref": "script:first", "weight": 1.0}
    league = counting([4, 6], [], teacher=teacher, opponents=[{"ref": "script:random", "share": 0.5}])
    chunks = {part.policy: part for part in episodes_of(league, taught=("policy_1",))}
    assert chunks["policy_0"].taught is None
    assert chunks["policy_1"].taught is not None
    assert len(chunks["policy_1"].taught) == len(chunks["policy_1"].actions) == chunks["policy_1"].lengths.sum()


def test_random_choices_of_the_teacher_repeat_with_the_episodes() -> None:
    league = with_teacher("script:random")
    runner = BatchedEnvRunner(config=algorithm_config(league, interface(league)), worker_index=0)
    samples = []
    for _ in range(2):
        runner.reset_episodes(64)
        samples.append([chunks for _ in range(2) for chunks in runner.sample_chunks(taught=("shared",))])
    runner.stop()
    for first, second in zip(*samples, strict=True):
        assert first.taught is not None
        assert second.taught is not None
        np.testing.assert_array_equal(first.taught, second.taught)
        np.testing.assert_array_equal(first.taught, teacher_of(league).actions(first))
        assert (first.taught != first.actions).any()


def test_unsuitable_actions_are_rejected() -> None:
    league = solvable("numbers", teacher={"ref": "script:first", "weight": 0.1})
    with pytest.raises(ConfigError, match=r"training\.teacher needs discrete actions"):
        algorithm_config(league, interface(league))


@pytest.mark.parametrize("runners", [0, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("ref", "error", "message"),
    [
        (
            f"script:{MODULE}:Alternating",
            ConfigError,
            "training.teacher.ref: {} has a memory, which a teacher",
        ),
        ("tictactoe@1", ConfigError, "training.teacher.ref: {} is a version, but no storage is given to load it from"),
        (f"script:{MODULE}:text", GameCrashed, "training.teacher: {}: MalformedAction: "),
    ],
    ids=["memory", "version", "fault"],
)
def test_errors_of_the_teacher_end_training(
    ref: str, error: type[LeagueError], message: str, runners: int, tmp_path: Path
) -> None:
    """The last one with the first sample, the others before it."""
    league = with_teacher(ref, runners=runners)
    with pytest.raises(Exception) as raised, running(league) as algorithm:  # noqa: PT011
        algorithm.train()
    cause = training_error(raised.value, league.league, tmp_path)
    assert isinstance(cause, error)
    assert str(cause).startswith(message.format(ref))
