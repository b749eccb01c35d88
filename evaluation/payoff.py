"""The payoff table: who scores how much against whom, and on which side."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from evaluation.report import Payoff
from league.results.records import Match

Row = tuple[float | None, ...]


def tabulate(contestants: Sequence[str], sides: Sequence[str], matches: Iterable[Match]) -> Payoff:
    """Mean scores and games of each ordered pair of `contestants`, over all games and by the side that the row played.

    Matches are of two contestants each. `score[i][j] + score[j][i] = 1` for pairs that met.
    """
    total, by_side = _Table(contestants), {side: _Table(contestants) for side in sides}
    for match in matches:
        for game in match.games:
            for side, row in zip(sides, game.sides, strict=True):
                pair = (match.contestants[row], match.contestants[1 - row])
                total.add(pair, game.scores[row])
                by_side[side].add(pair, game.scores[row])
    tables = {side: table.means() for side, table in by_side.items()}
    return Payoff(tuple(contestants), total.means(), total.counts(), tables)


class _Table:
    def __init__(self, contestants: Sequence[str]) -> None:
        self._index = {name: i for i, name in enumerate(contestants)}
        shape = (len(contestants), len(contestants))
        self._points: NDArray[np.float64] = np.zeros(shape)
        self._games: NDArray[np.int64] = np.zeros(shape, dtype=np.int64)

    def add(self, pair: tuple[str, str], points: float) -> None:
        row, column = (self._index[name] for name in pair)
        self._points[row, column] += points
        self._games[row, column] += 1

    def means(self) -> tuple[Row, ...]:
        return tuple(
            tuple(float(p / n) if n else None for p, n in zip(points, games, strict=True))
            for points, games in zip(self._points, self._games, strict=True)
        )

    def counts(self) -> tuple[tuple[int, ...], ...]:
        return tuple(tuple(int(n) for n in row) for row in self._games)
