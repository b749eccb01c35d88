"""Games that were lost by rule: a contestant had to act and gave no action that could be played.

How they are scored is said in league/results/scoring.py.
"""

from __future__ import annotations

from collections.abc import Iterable

from league.results.records import Match


def forfeits(matches: Iterable[Match], contestant: str) -> int:
    """How many games of `matches` a contestant forfeited."""
    return sum(
        match.contestants[forfeit.contestant] == contestant
        for match in matches
        for game in match.games
        for forfeit in game.forfeits
    )
