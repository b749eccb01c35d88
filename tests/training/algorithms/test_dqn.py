"""Sequences, exploration and priorities of DQN. What it has in common with others: `test_off_policy.py`."""

from typing import Any

import pytest
import torch

from league.config.schedules import ScheduleProgress
from tests.support.environments.training_environments import ROUNDS
from tests.support.leagues.training_leagues import solvable_by_dqn
from tests.support.off_policy import train
from training.algorithms.off_policy import OffPolicy
from training.learners.off_policy import ReplayBatch
from training.replay_buffer import ReplayBuffer
from training.sampling.closed_transitions import REWARDS

pytestmark = pytest.mark.usefixtures("ray_session")


def test_rows_after_the_end_of_an_episode_do_not_count() -> None:
    """Sequences of five steps in episodes of four: each sequence ends with a repeated row."""
    sequence = ROUNDS + 1
    league = solvable_by_dqn("discrete", recurrence={"width": 4, "sequence": sequence}, batch_size=4)

    def losses(algorithm: OffPolicy, _: Any) -> tuple[Any, Any]:
        learner, sample = algorithm.learner_group._learner, algorithm.draw_sample(algorithm.replays["shared"])
        batch = learner.batch(sample)
        changed = {**batch.rows, REWARDS: torch.where(batch.weights > 0, batch.rows[REWARDS], 1e6)}
        assert (batch.weights.reshape(-1, sequence)[:, -1] == 0).all()
        return tuple(
            learner.losses({"shared": ReplayBatch(rows, batch.weights)}, ["shared"])["shared"]
            for rows in (batch.rows, changed)
        )

    kept, changed = train(league, 2, losses)
    assert kept.total == changed.total > 0
    assert kept.statistics["error"] == changed.statistics["error"]


def test_exploration_follows_the_steps_and_the_correction_by_priorities_the_budget(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Steps include those of parent versions, the budget is the run's own."""
    league = solvable_by_dqn("discrete", priorities={"beta": 0.4}, exploration={"steps": 2048, "final": 0.1})
    betas: list[float] = []
    sample = ReplayBuffer.sample

    def record_beta(self: ReplayBuffer, *arguments: Any, beta: float = 1.0, **options: Any) -> Any:
        betas.append(beta)
        return sample(self, *arguments, beta=beta, **options)

    def inspect_algorithm(algorithm: OffPolicy, result: dict[str, Any]) -> tuple[int, float, float]:
        algorithm.progress = ScheduleProgress(algorithm.steps, budget=0.25)
        algorithm.draw_sample(algorithm.replays["shared"])
        return algorithm.steps, result["exploration"], betas[-1]

    monkeypatch.setattr(ReplayBuffer, "sample", record_beta)
    assert train(league, 1, inspect_algorithm) == (1024, pytest.approx(0.55), pytest.approx(0.55))
    assert betas[0] == 0.4
    assert train(league, 3, inspect_algorithm) == (3072, pytest.approx(0.1), pytest.approx(0.55))
