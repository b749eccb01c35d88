import numpy as np
import pytest
import torch

from league.environments.building import interface
from tests.training.leagues import maddpg
from training.algorithms.maddpg import algorithm_config
from training.replay import Block
from training.sampling.actor_runner import ActorRunner
from training.sampling.closed import JOINT

OWN = {"a": ["player_0"], "b": ["player_1"]}
DEVIATION = 0.2
COPIES = 200

pytestmark = pytest.mark.usefixtures("ray_session")


def played(theta: float | None) -> Block:
    """Four rounds in each copy, by actors that always mean 0."""
    league = maddpg("summing", {}, OWN, theta=theta, copies=COPIES)
    runner = ActorRunner(config=algorithm_config(league, interface(league)), worker_index=0)
    try:
        for module in runner.module.values():
            torch.nn.init.zeros_(module.head.weight)
        _, blocks = runner.transitions(8 * COPIES * 2, DEVIATION)
    finally:
        runner.stop()
    return blocks[JOINT]


def noise(block: Block, agent: str) -> np.ndarray:
    """(steps, copies)"""
    return block.rows[f"actions/{agent}"].reshape(-1, COPIES)


def test_independent_noise_has_the_deviation_that_is_asked_for() -> None:
    drawn = noise(played(None), "a")
    assert drawn.std() == pytest.approx(DEVIATION, rel=0.1)
    assert abs(np.corrcoef(drawn[0], drawn[1])[0, 1]) < 0.25


def test_an_ornstein_uhlenbeck_process_goes_on_within_an_episode_and_begins_anew_with_the_next() -> None:
    block = played(0.15)
    drawn = noise(block, "a")
    assert np.corrcoef(drawn[2], drawn[3])[0, 1] > 0.6
    assert abs(np.corrcoef(drawn[3], drawn[4])[0, 1]) < 0.25, "an episode has four rounds"
    assert drawn[0].std() == pytest.approx(DEVIATION, rel=0.2)
    assert drawn[4].std() == pytest.approx(DEVIATION, rel=0.2)
    assert abs(np.corrcoef(drawn[3], noise(block, "b")[3])[0, 1]) < 0.25, "each agent has its own"


def test_rows_hold_no_state_which_critics_do_not_take() -> None:
    columns = played(None).rows
    assert "observations/b/observation" in columns
    assert not [name for name in columns if name.endswith("state")]
