from evaluation.payoff import tabulate
from league.results.records import Game, Match

SIDES = ("first", "second")


def match(contestants: tuple[str, str], points: tuple[float, float]) -> Match:
    """A block with the first contestant's points in its two games."""
    games = tuple(Game((i, 1 - i), 1, (), (), (p, -p), (p, 1 - p)) for i, p in enumerate(points))
    return Match("s/0", "league", "s", 0, contestants, 1, "digest", games)


def test_scores_games_and_sides() -> None:
    payoff = tabulate(
        ("a", "b", "c"),
        SIDES,
        [match(("a", "b"), (1.0, 0.5)), match(("b", "a"), (1.0, 0.0)), match(("c", "b"), (1, 1))],
    )
    assert payoff.contestants == ("a", "b", "c")
    assert payoff.score == ((None, 0.625, None), (0.375, None, 0.0), (None, 1.0, None))
    assert payoff.games == ((0, 4, 0), (4, 0, 2), (0, 2, 0))
    assert payoff.by_side["first"] == ((None, 1.0, None), (0.75, None, 0.0), (None, 1.0, None))
    assert payoff.by_side["second"] == ((None, 0.25, None), (0.0, None, 0.0), (None, 1.0, None))


def test_nobody_played() -> None:
    assert tabulate(("a",), SIDES, []).score == ((None,),)
