"""Sequential tests on simulated blocks: the fraction of promotions, and the number of blocks.

Blocks are drawn from probabilities of the five cells (LL, LD, DD or WL, WD, WW). The probabilities for a stronger
challenger are those of equal players, tilted exponentially to the required effect of a game.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from evaluation.gating.gate import decision_bounds
from evaluation.statistics.sequential import ELO_PER_EFFECT, gsprt_llr, score_of
from league.config.gate import GateConfig

CELLS = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
EQUALS = {
    "decisive": (0.25, 0.0, 0.5, 0.0, 0.25),
    "first mover wins": (0.08, 0.06, 0.72, 0.06, 0.08),
    "drawish": (0.03, 0.17, 0.6, 0.17, 0.03),
}
"""Probabilities of the cells between equal players."""
AT_ONCE = 50
"""Number of blocks between two checks for finished tests."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Gates:
    """Results of many tests: `promoted` and `blocks` of each."""

    promoted: NDArray[np.bool_]
    blocks: NDArray[np.int64]


def stronger(shares: tuple[float, ...], elo: float, model: str = "normalized") -> Floats:
    """The cell probabilities of a player that is `elo` stronger, in Elo of `model`."""

    def gap(theta: float) -> float:
        p = _tilted(shares, theta)
        mean = float(p @ CELLS)
        if model == "logistic":
            return mean - score_of(elo)
        deviation = float(np.sqrt(p @ (CELLS - mean) ** 2))
        return (mean - 0.5) / deviation - elo / ELO_PER_EFFECT * np.sqrt(2)

    return _tilted(shares, brentq(gap, -30, 30))


def _tilted(shares: tuple[float, ...], theta: float) -> Floats:
    weighted = np.asarray(shares) * np.exp(theta * CELLS)
    return np.asarray(weighted / weighted.sum())


def simulate(settings: GateConfig, shares: Floats, gates: int, seed: int) -> Gates:
    """Many tests on random blocks of two games, whose cells have the probabilities `shares`."""
    rng = np.random.default_rng(seed)
    return simulate_draws(
        settings, 5, gates, lambda running, steps: rng.choice(5, p=shares, size=(len(running), steps))
    )


Draw = Callable[[NDArray[np.int64], int], NDArray[np.int64]]
"""Returns the cells of the next blocks of some gates. Arguments: their numbers, and the number of blocks of each.
Result: shape (gates, blocks)."""


def simulate_draws(settings: GateConfig, cells: int, gates: int, draw: Draw) -> Gates:
    """Many tests on random blocks, each stopped as by `evaluation.gating.gate.decide`. cells: number of cells."""
    lower, upper = decision_bounds(settings)
    assert settings.model != "returns"
    counts = np.zeros((gates, cells))
    promoted, blocks = np.zeros(gates, dtype=bool), np.full(gates, settings.max_blocks)
    running = np.arange(gates)
    for start in range(0, settings.max_blocks, AT_ONCE):
        steps = min(AT_ONCE, settings.max_blocks - start)
        prefixes = np.eye(cells)[draw(running, steps)].cumsum(axis=1) + counts[running, None]
        curves = gsprt_llr(prefixes, settings.elo0, settings.elo1, settings.model)
        outside = (curves <= lower) | (curves >= upper)
        ended, at = outside.any(axis=1), outside.argmax(axis=1)
        blocks[running[ended]] = start + at[ended] + 1
        promoted[running[ended]] = curves[ended, at[ended]] >= upper
        counts[running] = prefixes[:, -1]
        running = running[~ended]
        if not running.size:
            break
    return Gates(promoted, blocks)
