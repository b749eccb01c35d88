"""What else than its own row influences an output, for graphs that are NumPy functions."""

from collections.abc import Callable, Mapping

import numpy as np
import pytest
from numpy.typing import NDArray

from league.spaces import Discrete
from training.export.parity import influence

ROWS = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)


def outputs(logits: Callable[[NDArray], NDArray]) -> Callable[[Mapping[str, NDArray]], list[NDArray]]:
    """A graph of `x` with greedy actions."""

    def run(arrays: Mapping[str, NDArray]) -> list[NDArray]:
        values = logits(arrays["x"])
        return [values.argmax(axis=1), values]

    return run


def test_rows_by_themselves_have_no_influence() -> None:
    assert influence(outputs(lambda x: 2 * x), {"x": ROWS}, Discrete(n=3)) is None
    assert influence(outputs(lambda x: np.where(x > 0, -np.inf, x * np.nan)), {"x": ROWS}, Discrete(n=3)) is None


@pytest.mark.parametrize(
    ("logits", "problem"),
    [
        (
            lambda x: x - x.mean(axis=0),
            "computes other outputs for 20 of 20 observations alone than in a batch: its rows",
        ),
        (
            lambda x: x + (len(x) > 1),
            "computes other outputs for 20 of 20 observations alone than in a batch: its rows",
        ),
        (
            lambda x: x + (np.arange(len(x))[:, np.newaxis] * 10 if x[0, 0] != ROWS[0, 0] and len(x) > 1 else 0),
            "computes other outputs for 19 of 20 observations in another order: its rows",
        ),
        (lambda x: x[::-1], "computes other outputs for 20 of 20 observations alone than in a batch: its rows"),
        (
            lambda x: x if len(x) > 1 else np.ones((2, 3)),
            "fails on a single observation: 20 single runs have an output",
        ),
    ],
)
def test_other_rows_that_matter_are_found(logits: Callable[[NDArray], NDArray], problem: str) -> None:
    assert str(influence(outputs(logits), {"x": ROWS}, Discrete(n=3))).startswith(problem)


def test_chance_is_found() -> None:
    rng = np.random.default_rng(0)
    problem = influence(outputs(lambda x: x + rng.normal(size=x.shape)), {"x": ROWS})
    assert str(problem).startswith("computes other outputs for 20 of 20 observations in a second run: as with Dropout")


@pytest.mark.parametrize(("gap", "wrong"), [(1e-6, False), (1e-4, True)])
def test_only_near_ties_excuse_a_greedy_action(gap: float, wrong: bool) -> None:
    def logits(x: NDArray) -> NDArray:
        return np.stack([np.zeros(len(x)), np.full(len(x), gap if len(x) > 1 else -gap)], axis=1)

    assert (influence(outputs(logits), {"x": ROWS}, Discrete(n=2)) is not None) is wrong
