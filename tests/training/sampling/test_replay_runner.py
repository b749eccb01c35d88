from typing import Any

import numpy as np
import pytest
import torch

from league.environments.building import interface
from tests.support.leagues.training_leagues import maddpg
from training.algorithms.rllib_config import algorithm_config
from training.replay_buffer import TransitionBlock
from training.sampling.closed_transitions import JOINT
from training.sampling.replay_runner import ActorRunner

OWN = {"a": ["player_0"], "b": ["player_1"]}
DEVIATION = 0.2
NUM_ENVS = 200


def sample_rounds(rounds: int = 8, worker: int = 0, **training: Any) -> TransitionBlock:
    """Rounds of two agents in each environment, by actors with a mean of 0."""
    league = maddpg("summing", {}, OWN, num_envs=NUM_ENVS, **training)
    runner = ActorRunner(config=algorithm_config(league, interface(league)), worker_index=worker)
    try:
        for module in runner.module.values():
            torch.nn.init.zeros_(module.head.weight)
        _, blocks = runner.transitions(2 * rounds * NUM_ENVS, DEVIATION)
    finally:
        runner.stop()
    return blocks[JOINT]


def noise(block: TransitionBlock, agent: str) -> np.ndarray:
    """(steps, environments)"""
    return block.rows[f"actions/{agent}"].reshape(-1, NUM_ENVS)


def test_independent_noise_has_the_configured_deviation() -> None:
    samples = noise(sample_rounds(), "a")
    assert samples.std() == pytest.approx(DEVIATION, rel=0.1)
    assert abs(np.corrcoef(samples[0], samples[1])[0, 1]) < 0.25


def test_a_remote_runner_explores_by_its_seed() -> None:
    """Whatever the random generator of its process was used for before."""

    def sample(seed: int, state_of_process: int) -> np.ndarray:
        torch.manual_seed(state_of_process)
        return noise(sample_rounds(4, worker=1, seed=seed), "a")

    np.testing.assert_array_equal(sample(0, 1), sample(0, 2))
    assert (sample(0, 1) != sample(1, 1)).any()


def test_the_noise_of_a_remote_runner_depends_on_seed_and_steps_only() -> None:
    """Noisy networks draw from torch's generator, so that a resumed run continues as the uninterrupted one would."""
    league = maddpg("summing", {}, OWN, num_envs=2)
    runner = ActorRunner(config=algorithm_config(league, interface(league)), worker_index=1)

    def draw_after(steps: int) -> list[float]:
        runner.reset_episodes(steps)
        return torch.rand(4).tolist()

    try:
        assert draw_after(1000) == draw_after(1000)
        assert draw_after(1000) != draw_after(2000)
    finally:
        runner.stop()


def test_ornstein_uhlenbeck_noise_continues_within_an_episode_only() -> None:
    block = sample_rounds(theta=0.15)
    samples = noise(block, "a")
    assert np.corrcoef(samples[2], samples[3])[0, 1] > 0.6
    assert abs(np.corrcoef(samples[3], samples[4])[0, 1]) < 0.25, "noise restarts after four rounds"
    assert samples[0].std() == pytest.approx(DEVIATION, rel=0.2)
    assert samples[4].std() == pytest.approx(DEVIATION, rel=0.2)
    assert abs(np.corrcoef(samples[3], noise(block, "b")[3])[0, 1]) < 0.25, "agents have separate noise"


def test_rows_without_state_if_critics_do_not_use_it() -> None:
    columns = sample_rounds().rows
    assert "observations/b/observation" in columns
    assert not [name for name in columns if name.endswith("state")]
