from collections.abc import Sequence
from itertools import pairwise

import pytest

from evaluation.budget import Budget, Limit
from evaluation.course import LOOKS, Course, draw_up
from league.errors import EnvironmentMismatch, InvalidInput
from league.results.records import Match
from tests.evaluation.test_payoff import match
from tests.evaluation.test_schedule import CONFIG, INTERFACE

REFS = ("tictactoe@1", "script:random")


def course(blocks: int = 1000) -> Course:
    return draw_up(CONFIG, INTERFACE, "round_robin", REFS, blocks=blocks)


def played(number: int) -> Sequence[Match]:
    return [match(("tictactoe@1", "script:random"), (1, i % 2)) for i in range(number)]


def test_games_end_it_at_the_last_whole_match() -> None:
    limit = Limit(Budget(games=9), course())
    assert limit.most == 4
    assert not limit.is_reached(played(3))
    assert limit.is_reached(played(4))
    assert limit.counted(played(30)) == (played(4), "games")


def test_a_schedule_that_is_over_before_its_budget() -> None:
    limit = Limit(Budget(games=100, minutes=60), course(blocks=5))
    assert limit.is_reached(played(5))
    assert limit.counted(played(5)) == (played(5), "schedule")


def test_minutes_are_told_of() -> None:
    limit = Limit(Budget(minutes=1e-9), course())
    assert limit.is_reached(played(3))
    assert limit.counted(played(3)) == (played(3), "minutes")


@pytest.mark.parametrize("chunk", [1, 7, 64, 1000])
def test_precision_ends_it_at_the_same_match_whatever_the_chunks(chunk: int) -> None:
    limit = Limit(Budget(precision=50), course())
    matches, ended = played(1000), 0
    while not limit.is_reached(matches[:ended]):
        ended += chunk
    counted, stopped_by = limit.counted(matches[:ended])
    assert stopped_by == "precision"
    assert len(counted) == len(Limit(Budget(precision=50), course()).counted(matches)[0])
    assert 20 < len(counted) < 200


def test_a_coarser_precision_is_reached_earlier() -> None:
    ends = [len(Limit(Budget(precision=elo), course()).counted(played(1000))[0]) for elo in (200, 60, 20)]
    assert ends == sorted(set(ends))


@pytest.mark.parametrize("kind", ["round_robin", "adaptive"])
def test_looks_are_ends_of_rounds_ever_farther_apart(kind: str) -> None:
    drawn = draw_up(CONFIG, INTERFACE, kind, ("a", "b", "c"), blocks=4000)  # type: ignore[arg-type]
    looks = list(drawn.looks())
    rounds = set()
    for end in drawn.rounds():
        rounds.add(end)
        if end >= drawn.length:
            break
    assert set(looks) <= rounds
    assert all(later >= LOOKS * earlier for earlier, later in pairwise(looks))
    assert looks[0] == 3
    assert looks[-1] > drawn.length / 1.3


@pytest.mark.parametrize(
    ("budget", "word"),
    [({"games": 1}, "games"), ({"minutes": 0}, "minutes"), ({"precision": -3}, "precision")],
)
def test_a_budget_of_nothing_is_refused(budget: dict[str, float], word: str) -> None:
    with pytest.raises(InvalidInput, match=word):
        Budget(**budget)  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ["round_robin", "adaptive"])
def test_one_contestant_alone_has_no_course(kind: str) -> None:
    with pytest.raises(EnvironmentMismatch, match="two contestants"):
        draw_up(CONFIG, INTERFACE, kind, REFS[:1])  # type: ignore[arg-type]


def test_an_adaptive_course_plays_a_quarter() -> None:
    assert draw_up(CONFIG, INTERFACE, "adaptive", "abcdefgh", blocks=32).length == 28 * 8
