from collections.abc import Sequence
from itertools import pairwise

import pytest

from evaluation.schedules.tournament_plan import CHECK_GROWTH, Budget, StoppingRule, TournamentPlan, plan_tournament
from league.errors import EnvironmentMismatch, InvalidInput
from league.results.records import Match
from tests.support.leagues.payoff_matches import match
from tests.support.leagues.schedules import CONFIG, INTERFACE

REFS = ("tictactoe@1", "script:random")


def plan(blocks: int = 1000) -> TournamentPlan:
    return plan_tournament(CONFIG, INTERFACE, "round_robin", REFS, blocks=blocks)


def matches_of(number: int) -> Sequence[Match]:
    return [match(("tictactoe@1", "script:random"), (1, i % 2)) for i in range(number)]


def test_the_number_of_games_is_rounded_to_matches() -> None:
    limit = StoppingRule(Budget(games=9), plan())
    assert limit.most == 4
    assert not limit.is_reached(matches_of(3))
    assert limit.is_reached(matches_of(4))
    assert limit.counted(matches_of(30)) == (matches_of(4), "games")


def test_a_schedule_can_end_before_its_budget() -> None:
    limit = StoppingRule(Budget(games=100, minutes=60), plan(blocks=5))
    assert limit.is_reached(matches_of(5))
    assert limit.counted(matches_of(5)) == (matches_of(5), "schedule")


def test_minutes_are_reported() -> None:
    limit = StoppingRule(Budget(minutes=1e-9), plan())
    assert limit.is_reached(matches_of(3))
    assert limit.counted(matches_of(3)) == (matches_of(3), "minutes")


@pytest.mark.parametrize("chunk", [1, 7, 64, 1000])
def test_precision_stops_at_the_same_match_for_any_chunks(chunk: int) -> None:
    limit = StoppingRule(Budget(precision=50), plan())
    matches, number = matches_of(1000), 0
    while not limit.is_reached(matches[:number]):
        number += chunk
    counted, stopped_by = limit.counted(matches[:number])
    assert stopped_by == "precision"
    assert len(counted) == len(StoppingRule(Budget(precision=50), plan()).counted(matches)[0])
    assert 20 < len(counted) < 200


def test_a_lower_precision_is_reached_earlier() -> None:
    ends = [len(StoppingRule(Budget(precision=elo), plan()).counted(matches_of(1000))[0]) for elo in (200, 60, 20)]
    assert ends == sorted(set(ends))


@pytest.mark.parametrize("kind", ["round_robin", "adaptive"])
def test_looks_are_at_ends_of_rounds_at_increasing_intervals(kind: str) -> None:
    tournament = plan_tournament(CONFIG, INTERFACE, kind, ("a", "b", "c"), blocks=4000)  # type: ignore[arg-type]
    checks = list(tournament.precision_checks())
    rounds = set()
    for end in tournament.rounds():
        rounds.add(end)
        if end >= tournament.length:
            break
    assert set(checks) <= rounds
    assert all(later >= CHECK_GROWTH * earlier for earlier, later in pairwise(checks))
    assert checks[0] == 3
    assert checks[-1] > tournament.length / 1.3


@pytest.mark.parametrize(
    ("budget", "message"),
    [({"games": 1}, "games"), ({"minutes": 0}, "minutes"), ({"precision": -3}, "precision")],
)
def test_an_empty_budget_is_rejected(budget: dict[str, float], message: str) -> None:
    with pytest.raises(InvalidInput, match=message):
        Budget(**budget)  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ["round_robin", "adaptive"])
def test_a_single_contestant_has_no_plan(kind: str) -> None:
    with pytest.raises(EnvironmentMismatch, match="two contestants"):
        plan_tournament(CONFIG, INTERFACE, kind, REFS[:1])  # type: ignore[arg-type]


def test_an_adaptive_plan_plays_a_quarter() -> None:
    assert plan_tournament(CONFIG, INTERFACE, "adaptive", "abcdefgh", blocks=32).length == 28 * 8
