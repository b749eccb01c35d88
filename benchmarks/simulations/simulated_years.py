"""Years of nightly runs with candidates that are not better than the champion: how often is one of them promoted?

A year of 365 nights with 8 candidates has 2,920 tests, and 1,000 years have three million: too many to compute the
likelihood ratio of each block. If each game has a winner, a block is lost, shared or won, and the state of a test
depends only on three counts. Therefore the gate is evaluated once for each possible state of a test, and tests are
walks through that table. The same table gives the probability of a false promotion without sampling error, by adding up
the probabilities of all walks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evaluation.gating.gate import decision_bounds
from evaluation.statistics.sequential import gsprt_llr
from league.config.gate import GateConfig

OPEN, REJECTED, PROMOTED = 0, 1, 2
Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Boundary:
    """Where a test ends: `at[n - 1]` is the state after n blocks by (won, lost), from `corner[n - 1]` on."""

    corners: Sequence[tuple[int, int]]
    tables: Sequence[NDArray[np.int8]]

    def states(self, blocks: int, won: NDArray[np.int64], lost: NDArray[np.int64]) -> NDArray[np.int8]:
        """The states of tests with these counts after this number of blocks."""
        (first, second), table = self.corners[blocks - 1], self.tables[blocks - 1]
        row, column = won - first, lost - second
        inside = (row >= 0) & (column >= 0) & (row < table.shape[0]) & (column < table.shape[1])
        if not inside.all():
            raise ArithmeticError(f"a walk left the table after {blocks} blocks")
        return table[row, column]


def boundary(settings: GateConfig, shares: Sequence[Floats]) -> Boundary:
    """Evaluate the gate for each state that walks with any of these probabilities (lost, shared, won) can reach.

    A state counts as reachable if the probability of reaching it, without stopping, is above 1e-12 for one of them.
    """
    lower, upper = decision_bounds(settings)
    assert settings.model != "returns"
    corner, mass = (0, 0), [np.ones((1, 1)) for _ in shares]
    corners, tables = [], []
    for blocks in range(1, settings.max_blocks + 1):
        mass = [_step(states, p) for states, p in zip(mass, shares, strict=True)]
        reachable = np.max(mass, axis=0) > 1e-12
        if not reachable.any():
            break  # all tests have ended
        corner, reachable, mass = _trimmed(corner, reachable, mass)
        won, lost = (axis + start for axis, start in zip(np.nonzero(reachable), corner, strict=True))
        counts = np.zeros((len(won), 5))
        counts[:, 0], counts[:, 2], counts[:, 4] = lost, blocks - won - lost, won
        llr = gsprt_llr(counts, settings.elo0, settings.elo1, settings.model)
        table = np.zeros(reachable.shape, dtype=np.int8)
        table[reachable] = np.where(llr >= upper, PROMOTED, np.where(llr <= lower, REJECTED, OPEN))
        mass = [np.where(table == OPEN, states, 0.0) for states in mass]
        corners.append(corner)
        tables.append(table)
    return Boundary(corners, tables)


def chance(ends: Boundary, shares: Floats) -> float:
    """The exact probability of promotion for a challenger whose blocks have these probabilities (lost, shared, won)."""
    corner, mass, promoted = (0, 0), np.ones((1, 1)), 0.0
    for table, (first, second) in zip(ends.tables, ends.corners, strict=True):
        mass = _step(mass, shares)
        mass = _window(mass, (first - corner[0], second - corner[1]), table.shape)
        corner = (first, second)
        promoted += float(mass[table == PROMOTED].sum())
        mass = np.where(table == OPEN, mass, 0.0)
    return promoted


def walk(
    settings: GateConfig, ends: Boundary, shares: Floats, gates: int, rng: np.random.Generator
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Simulate tests: which ones were promoted, and after how many blocks each ended."""
    won, lost = np.zeros(gates, dtype=np.int64), np.zeros(gates, dtype=np.int64)
    promoted, length = np.zeros(gates, dtype=bool), np.full(gates, settings.max_blocks)
    running = np.arange(gates)
    for blocks in range(1, settings.max_blocks + 1):
        draw = rng.random(len(running))
        lost[running] += draw < shares[0]
        won[running] += draw >= shares[0] + shares[1]
        states = ends.states(blocks, won[running], lost[running])
        promoted[running[states == PROMOTED]] = True
        length[running[states != OPEN]] = blocks
        running = running[states == OPEN]
        if not running.size:
            break
    return promoted, length


def _step(mass: Floats, shares: Floats) -> Floats:
    """Add one block; (won, lost)."""
    grown = np.zeros((mass.shape[0] + 1, mass.shape[1] + 1))
    grown[:-1, :-1] = shares[1] * mass
    grown[:-1, 1:] += shares[0] * mass
    grown[1:, :-1] += shares[2] * mass
    return grown


def _trimmed(
    corner: tuple[int, int], reachable: NDArray[np.bool_], mass: list[Floats]
) -> tuple[tuple[int, int], NDArray[np.bool_], list[Floats]]:
    rows, columns = np.flatnonzero(reachable.any(axis=1)), np.flatnonzero(reachable.any(axis=0))
    box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    return (corner[0] + int(rows[0]), corner[1] + int(columns[0])), reachable[box], [states[box] for states in mass]


def _window(mass: Floats, offset: tuple[int, int], shape: tuple[int, ...]) -> Floats:
    """The part of `mass` from `offset` on with `shape`; zero outside of it."""
    cut = np.zeros(shape)
    part = mass[offset[0] : offset[0] + shape[0], offset[1] : offset[1] + shape[1]]
    cut[: part.shape[0], : part.shape[1]] = part
    return cut
