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


def by_rule(match: Match, contestant: str) -> float | None:
    """What stands in for a contestant's difference of returns in a block with a forfeit, in units of the greatest one
    that there can be: -1 where it alone forfeited a game, +1 where the other one did, 0 where both; None without any.
    """
    own = forfeits([match], contestant) > 0
    other = any(forfeits([match], ref) for ref in match.contestants if ref != contestant)
    return float(other) - float(own) if own or other else None
