"""Matches with given scores and returns."""

from league.results.records import Game, Match


def match(contestants: tuple[str, str], points: tuple[float, float]) -> Match:
    """A block in which the first contestant has these scores in its two games."""
    games = tuple(Game((i, 1 - i), 1, (), (), (p, -p), (p, 1 - p)) for i, p in enumerate(points))
    return Match("s/0", "league", "s", 0, contestants, 1, "digest", games)
