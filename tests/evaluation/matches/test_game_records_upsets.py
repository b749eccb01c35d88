from dataclasses import replace
from itertools import permutations

from evaluation.matches import game_records
from evaluation.matches.game_records import Upset
from league.results.records import Game, Match
from league.results.sums import examples, game_digest

RATINGS = {"duel@1": 0.0, "duel@2": 400.0, "duel@3": 800.0}


def match(position: int, contestants: tuple[str, str], *scores: float, moves: int | None = None) -> Match:
    """One game for each score of the first contestant; its moves identify it."""
    actions = (position if moves is None else moves,)
    games = tuple(
        Game((0, 1), position, (), (*actions, index), (score, 1 - score), (score, 1 - score))
        for index, score in enumerate(scores)
    )
    return Match(f"s/{position}", "duel", "s", position, contestants, position, "digest", games)


def greatest_upsets(matches: list[Match], limit: int = 3) -> list[tuple[str, int, str]]:
    return [(upset.match, upset.game, upset.better) for upset in upsets_of(matches, limit)]


def upsets_of(matches: list[Match], limit: int) -> list[Upset]:
    of_pairs = examples(matches, [[game_digest(match, game) for game in match.games] for match in matches])
    return game_records.greatest_upsets(RATINGS, of_pairs, of_pairs.__getitem__, limit)


def test_the_least_expected_results_come_first() -> None:
    matches = [
        match(0, ("duel@1", "duel@2"), 0.0, 1.0),
        match(1, ("duel@3", "duel@1"), 1.0, 0.0),
        match(2, ("duel@2", "duel@3"), 1.0, 0.0),
    ]
    assert greatest_upsets(matches) == [("s/1", 1, "duel@1"), ("s/0", 1, "duel@1"), ("s/2", 0, "duel@2")]


def test_an_expected_result_is_not_an_upset_but_a_draw_of_unequals_is() -> None:
    assert greatest_upsets([match(0, ("duel@1", "duel@2"), 0.0, 0.5)]) == [("s/0", 1, "duel@1")]
    assert greatest_upsets([match(0, ("duel@1", "duel@2"), 0.0, 0.0)]) == []
    (upset,) = upsets_of([match(0, ("duel@1", "duel@2"), 1.0)], limit=1)
    assert (upset.other, upset.score, round(upset.expected, 3)) == ("duel@2", 1.0, 0.091)


def test_each_pair_is_listed_once_before_any_is_repeated() -> None:
    repeated = [match(i, ("duel@1", "duel@3"), 1.0) for i in range(5)]
    assert greatest_upsets([*repeated, match(9, ("duel@1", "duel@2"), 1.0)], limit=2) == [
        ("s/0", 0, "duel@1"),
        ("s/9", 0, "duel@1"),
    ]
    assert len(greatest_upsets(repeated, limit=3)) == 3, "then the others follow"


def test_a_repeated_game_is_one_upset() -> None:
    repeated = [match(i, ("duel@1", "duel@3"), 1.0, moves=7) for i in range(4)]
    assert greatest_upsets(repeated) == [("s/0", 0, "duel@1")]


def test_the_order_of_games_does_not_matter() -> None:
    matches = [match(i, ("duel@1", "duel@3"), 1.0, 0.5, moves=i // 2) for i in range(4)]
    matches.append(match(5, ("duel@2", "duel@3"), 1.0))
    assert len({tuple(greatest_upsets(list(order))) for order in permutations(matches)}) == 1


def test_unrated_contestants_have_no_upsets() -> None:
    unrated = replace(match(0, ("duel@1", "duel@3"), 1.0), contestants=("duel@9", "duel@3"))
    assert greatest_upsets([unrated]) == []


def test_solo_games_are_compared_with_each_other() -> None:
    block = match(0, ("duel@1", "duel@3"), 1.0)
    game = replace(block.games[0], sides=(0,), scores=(1.0, None))
    other = replace(block.games[0], sides=(1,), scores=(None, 0.0))
    assert greatest_upsets([replace(block, games=(game, other))]) == [("s/0", 0, "duel@1")]
