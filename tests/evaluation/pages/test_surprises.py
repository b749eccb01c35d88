from dataclasses import replace
from itertools import permutations

from evaluation.pages.surprises import Surprises
from league.results.records import Game, Match

RATINGS = {"duel@1": 0.0, "duel@2": 400.0, "duel@3": 800.0}


def match(position: int, contestants: tuple[str, str], *scores: float, moves: int | None = None) -> Match:
    """One game for each score of the first contestant; its moves tell it from others."""
    actions = (position if moves is None else moves,)
    games = tuple(
        Game((0, 1), position, (), (*actions, index), (score, 1 - score), (score, 1 - score))
        for index, score in enumerate(scores)
    )
    return Match(f"s/{position}", "duel", "s", position, contestants, position, "digest", games)


def greatest(matches: list[Match], most: int = 3) -> list[tuple[str, int, str]]:
    seen = Surprises(RATINGS, most)
    for each in matches:
        seen.see(each)
    return [(found.match, found.game, found.better) for found in seen.greatest()]


def test_the_less_it_was_expected_the_sooner_it_comes() -> None:
    matches = [
        match(0, ("duel@1", "duel@2"), 0.0, 1.0),
        match(1, ("duel@3", "duel@1"), 1.0, 0.0),
        match(2, ("duel@2", "duel@3"), 1.0, 0.0),
    ]
    assert greatest(matches) == [("s/1", 1, "duel@1"), ("s/0", 1, "duel@1"), ("s/2", 0, "duel@2")]


def test_what_was_expected_is_no_surprise_and_a_draw_of_very_unequals_is_one() -> None:
    assert greatest([match(0, ("duel@1", "duel@2"), 0.0, 0.5)]) == [("s/0", 1, "duel@1")]
    assert greatest([match(0, ("duel@1", "duel@2"), 0.0, 0.0)]) == []
    found = Surprises(RATINGS, 1)
    found.see(match(0, ("duel@1", "duel@2"), 1.0))
    (surprise,) = found.greatest()
    assert (surprise.other, surprise.score, round(surprise.expected, 3)) == ("duel@2", 1.0, 0.091)


def test_each_pair_comes_once_before_any_comes_twice() -> None:
    often = [match(i, ("duel@1", "duel@3"), 1.0) for i in range(5)]
    assert greatest([*often, match(9, ("duel@1", "duel@2"), 1.0)], most=2) == [
        ("s/0", 0, "duel@1"),
        ("s/9", 0, "duel@1"),
    ]
    assert len(greatest(often, most=3)) == 3, "and then the others have their turn"


def test_one_game_played_often_is_one_surprise() -> None:
    same = [match(i, ("duel@1", "duel@3"), 1.0, moves=7) for i in range(4)]
    assert greatest(same) == [("s/0", 0, "duel@1")]


def test_the_order_in_which_games_are_seen_changes_nothing() -> None:
    matches = [match(i, ("duel@1", "duel@3"), 1.0, 0.5, moves=i // 2) for i in range(4)]
    matches.append(match(5, ("duel@2", "duel@3"), 1.0))
    assert len({tuple(greatest(list(order))) for order in permutations(matches)}) == 1


def test_who_is_not_rated_surprises_nobody() -> None:
    stranger = replace(match(0, ("duel@1", "duel@3"), 1.0), contestants=("duel@9", "duel@3"))
    assert greatest([stranger]) == []


def test_who_played_alone_is_compared_with_the_other_game() -> None:
    alone = match(0, ("duel@1", "duel@3"), 1.0)
    game = replace(alone.games[0], sides=(0,), scores=(1.0, None))
    other = replace(alone.games[0], sides=(1,), scores=(None, 0.0))
    assert greatest([replace(alone, games=(game, other))]) == [("s/0", 0, "duel@1")]
