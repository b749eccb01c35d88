"""MADDPG and DDPG learn. What they have in common with other algorithms: `test_off_policy.py`."""

from pathlib import Path

import numpy as np
import pytest
from ray.rllib.algorithms.algorithm import Algorithm

from league.config.league import LeagueConfig
from league.environments.building import interface
from league.errors import EnvironmentMismatch
from tests.support.environments.training_environments import ROUNDS
from tests.support.leagues.training_leagues import maddpg
from training.algorithms.maddpg import MADDPG
from training.runs.trial import build_algorithm

OWN = {"a": ["player_0"], "b": ["player_1"]}
TWO = {"agents": 2}

pytestmark = pytest.mark.usefixtures("ray_session")


def start(league: LeagueConfig, checkpoint: Path | None = None, steps: int = 0) -> MADDPG:
    algorithm = build_algorithm(league, interface(league), checkpoint)
    assert isinstance(algorithm, MADDPG)
    algorithm.reset_episodes(steps)
    return algorithm


def returns(algorithm: Algorithm, episodes: int = 200) -> float:
    """Mean return of an agent with greedy actions."""
    chunks = algorithm.env_runner.sample(num_episodes=episodes, explore=False, force_reset=True)
    return float(np.mean([chunk.get_return() for chunk in chunks if chunk.is_done and chunk.t_started == 0]))


def turn_based_league() -> LeagueConfig:
    """A turn-based game with action masks."""
    return LeagueConfig.from_mapping(
        {
            "league": "turns",
            "environment": {"entry_point": "pettingzoo.classic.tictactoe_v3"},
            "training": {"algorithm": "maddpg", "runners": 0, "num_envs": 2, "hidden": [8]},
        }
    )


@pytest.mark.parametrize(
    ("critic", "theta"),
    [
        ("centralised", 0.15),
        pytest.param("centralised", None, marks=pytest.mark.slow),
        pytest.param("own", None, marks=pytest.mark.slow),
    ],
)
def test_learns_to_cooperate_with_continuous_actions(critic: str, theta: float | None) -> None:
    algorithm = start(maddpg("summing", {}, OWN, critic=critic, theta=theta))
    try:
        initial = returns(algorithm)
        while algorithm.steps < 8_000:
            algorithm.train()
        after = returns(algorithm)
    finally:
        algorithm.stop()
    assert initial < -0.4 * ROUNDS, "a constant action has a mean squared error of 2/3"
    assert after > -0.05 * ROUNDS


@pytest.mark.slow
def test_learns_opposed_tasks_with_discrete_actions() -> None:
    algorithm = start(maddpg("discrete", TWO | {"opposed": True}, OWN))
    try:
        while algorithm.steps < 8_000:
            algorithm.train()
        chunks = algorithm.env_runner.sample(num_episodes=100, explore=False, force_reset=True)
    finally:
        algorithm.stop()
    means = {
        agent: np.mean([chunk.get_return() for chunk in chunks if chunk.is_done and chunk.agent_id == agent])
        for agent in ("player_0", "player_1")
    }
    assert means["player_0"] > 0.9 * ROUNDS
    assert means["player_1"] > -0.1 * ROUNDS


def test_turn_based_games_are_rejected_before_learning() -> None:
    algorithm = start(turn_based_league())
    try:
        with pytest.raises(EnvironmentMismatch, match=r"league turns.*all agents act at once"):
            algorithm.train()
    finally:
        algorithm.stop()
