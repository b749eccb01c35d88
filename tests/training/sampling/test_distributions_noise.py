import numpy as np
import pytest

from training.sampling.distributions import OrnsteinUhlenbeck

THETA, SIGMA = 0.15, 0.2


def walk(steps: int, num_envs: int = 1) -> np.ndarray:
    """(steps, environments) of one agent with one element, around a mean of 3."""
    noise, rng = OrnsteinUhlenbeck(THETA, num_envs, 1, 1), np.random.default_rng(0)
    inputs = np.tile(np.array([[3.0, np.log(SIGMA)]], np.float32), (num_envs, 1))
    rows = range(num_envs)
    return np.stack([noise.draw(list(rows), [0] * num_envs, inputs, rng)[:, 0] for _ in range(steps)])


def test_the_noise_follows_its_equation() -> None:
    rng = np.random.default_rng(0)
    state, expected = 0.0, []
    for _ in range(20):
        state = (1 - THETA) * state + SIGMA * rng.standard_normal(dtype=np.float32)
        expected.append(3 + state)
    assert walk(20)[:, 0] == pytest.approx(np.array(expected), abs=1e-6)


def test_the_noise_is_correlated_and_stationary() -> None:
    late = walk(200, num_envs=4000)[100:] - 3
    deviation = SIGMA / np.sqrt(1 - (1 - THETA) ** 2)
    assert late.std() == pytest.approx(deviation, rel=0.02)
    assert (late[1:] * late[:-1]).mean() / late.var() == pytest.approx(1 - THETA, abs=0.02)


def test_each_agent_has_its_own_noise_until_its_episode_ends() -> None:
    noise, rng = OrnsteinUhlenbeck(THETA, 2, 2, 1), np.random.default_rng(0)
    noisy, quiet = np.array([[0.0, 2.0]], np.float32), np.array([[0.0, -50.0]], np.float32)
    for env in (0, 1):
        noise.draw([env], [1], noisy, rng)
    assert noise.draw([0], [0], quiet, rng)[0, 0] == pytest.approx(0, abs=1e-6), "the other agent has its own noise"
    noise.forget(0)
    assert noise.draw([0], [1], quiet, rng)[0, 0] == pytest.approx(0, abs=1e-6)
    assert abs(noise.draw([1], [1], quiet, rng)[0, 0]) > 0.01, "the noise of the other environment continues"
