"""The payoff table: who scores how much against whom, on which side, and by how much returns differ."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from evaluation.paired import paired_difference
from evaluation.report import Payoff
from league.results.records import Game, Match

Row = tuple[float | None, ...]


def tabulate(contestants: Sequence[str], sides: Sequence[str], matches: Iterable[Match]) -> Payoff:
    """Mean scores and games of each ordered pair of `contestants`, over all games and by the side that the row played.

    A game counts for a side where the row played that side and no other.
    `score[i][j] + score[j][i] = 1` for pairs that met, and `difference[i][j].mean = -difference[j][i].mean`.
    """
    total, by_side = _Table(contestants), {side: _Table(contestants) for side in sides}
    met: defaultdict[tuple[str, str], list[Match]] = defaultdict(list)
    for match in matches:
        for row in (0, 1):
            pair = (match.contestants[row], match.contestants[1 - row])
            met[pair].append(match)
            for game in match.games:
                score = game.scores[row]
                if score is None:
                    continue
                total.add(pair, score)
                if (side := only_side(game, row)) is not None:
                    by_side[sides[side]].add(pair, score)
    return Payoff(
        tuple(contestants),
        total.means(),
        total.counts(),
        {side: table.means() for side, table in by_side.items()},
        tuple(tuple(paired_difference(met[row, column], row) for column in contestants) for row in contestants),
    )


def only_side(game: Game, contestant: int) -> int | None:
    """The side that a contestant played in a game, None if it played several or none."""
    own = [side for side, player in enumerate(game.sides) if player == contestant]
    return own[0] if len(own) == 1 else None


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
