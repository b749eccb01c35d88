import numpy as np
import pytest

from training.sampling.noise import OrnsteinUhlenbeck

THETA, SIGMA = 0.15, 0.2


def walk(steps: int, copies: int = 1) -> np.ndarray:
    """(steps, copies) of one agent with one element, around a mean of 3."""
    noise, rng = OrnsteinUhlenbeck(THETA, copies, 1, 1), np.random.default_rng(0)
    inputs = np.tile(np.array([[3.0, np.log(SIGMA)]], np.float32), (copies, 1))
    rows = range(copies)
    return np.stack([noise.draw(list(rows), [0] * copies, inputs, rng)[:, 0] for _ in range(steps)])


def test_is_the_process_of_its_equation() -> None:
    moves = np.random.default_rng(0)
    state, expected = 0.0, []
    for _ in range(20):
        state = (1 - THETA) * state + SIGMA * moves.standard_normal(dtype=np.float32)
        expected.append(3 + state)
    assert walk(20)[:, 0] == pytest.approx(np.array(expected), abs=1e-6)


def test_is_correlated_and_stationary() -> None:
    late = walk(200, copies=4000)[100:] - 3
    deviation = SIGMA / np.sqrt(1 - (1 - THETA) ** 2)
    assert late.std() == pytest.approx(deviation, rel=0.02)
    assert (late[1:] * late[:-1]).mean() / late.var() == pytest.approx(1 - THETA, abs=0.02)


def test_agents_have_their_own_and_lose_it_with_their_episode() -> None:
    noise, rng = OrnsteinUhlenbeck(THETA, 2, 2, 1), np.random.default_rng(0)
    loud, still = np.array([[0.0, 2.0]], np.float32), np.array([[0.0, -50.0]], np.float32)
    for copy in (0, 1):
        noise.draw([copy], [1], loud, rng)
    assert noise.draw([0], [0], still, rng)[0, 0] == pytest.approx(0, abs=1e-6), "the other agent has drawn nothing"
    noise.forget(0)
    assert noise.draw([0], [1], still, rng)[0, 0] == pytest.approx(0, abs=1e-6)
    assert abs(noise.draw([1], [1], still, rng)[0, 0]) > 0.01, "another copy's goes on"
