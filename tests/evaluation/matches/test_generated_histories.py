"""The sums that the ledger keeps are those of its matches, whatever was added, repeated, purged or changed."""

from contextlib import closing
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluation.matches.leaderboard import CountedGames, rank_contestants
from evaluation.statistics.payoff import tabulate
from league.conditions import Conditions
from league.registry.registry import Registry
from league.registry.storage import tables
from league.results.ledger import Ledger
from league.results.records import Forfeit, Game, Match, Schedule, Scoring
from league.results.scoring import scores
from league.results.sums import GameSums, examples, game_digest, load_examples, merged, tally, whole
from league.settings import Storage
from tests.support.leagues.ledger_matches import SCHEDULE
from tests.support.leagues.registries import LEAGUE, registered

REFS = ("script:random", "tictactoe@1", "tictactoe@10", "tictactoe@2")
TWO = ("player_1", "player_2")
SIDES: dict[tuple[str, ...], tuple[Scoring, ...]] = {
    TWO: ("game", "side", "team"),
    ("a", "b", "c"): ("side", "game"),
    ("alone",): ("side",),
}

History = list[tuple[Schedule, list[list[Match]], bool]]
"""Schedules with the matches that are added at a time, and whether they are purged."""


@st.composite
def schedules(draw: st.DrawFn, number: int) -> Schedule:
    sides = draw(st.sampled_from(list(SIDES)))
    pairs = st.tuples(st.integers(0, 3), st.integers(0, 3))
    return replace(
        SCHEDULE,
        id=f"schedule-{number}",
        sides=sides,
        scoring=draw(st.sampled_from(SIDES[sides])),
        contestants=tuple(draw(st.permutations(REFS))),
        pairings=tuple(draw(st.lists(pairs, min_size=1, max_size=3))),
        length=2 * tables.STRIPE,
        opening_plies=0,
        game_digest=draw(st.sampled_from([SCHEDULE.game_digest, "0" * 64])),
        actions=draw(st.sampled_from(["greedy", "sampled"])),
    )


@st.composite
def matches_of(draw: st.DrawFn, schedule: Schedule) -> Match:
    """A match with few different returns and moves, so that games are repeated; some with forfeits or mixtures."""
    position = draw(st.integers(0, 6) | st.integers(tables.STRIPE - 1, tables.STRIPE + 2))
    returns, forfeits = [], []
    for index in range(2):
        seating = schedule.seating_at(position, index)
        value = st.sampled_from([-1.0, 0.0, 0.1, 1.0, 1e-3, 1e17])
        returns.append(tuple(draw(value) if contestant in seating else None for contestant in range(2)))
        losers = draw(st.sampled_from([(), (), (), tuple(sorted(set(seating))), seating[:1]]))
        forfeits.append(tuple(Forfeit(contestant, "agent", "crashed") for contestant in losers))
    points = scores(returns, schedule.scoring, [{part.contestant for part in of_game} for of_game in forfeits])
    members = draw(st.sampled_from([(), (1, None)]))
    games = [
        Game(
            schedule.seating_at(position, index),
            schedule.seed_at(position),
            (),
            (draw(st.integers(0, 1)),),
            returns[index],
            points[index],
            forfeits[index],
            members,
        )
        for index in range(2)
    ]
    return schedule.match(position, games)


@st.composite
def histories(draw: st.DrawFn) -> History:
    history = []
    for number in range(draw(st.integers(1, 4))):
        schedule = draw(schedules(number))
        batches = draw(st.lists(st.lists(matches_of(schedule), max_size=6), max_size=4))
        history.append((schedule, batches, draw(st.booleans())))
    return history


def check(registry: Registry, history: History) -> None:
    ledger = Ledger(registry)
    for schedule, batches, is_purged in history:
        ledger.open(schedule)
        for batch in batches:
            ledger.extend(batch)
            ledger.extend(batch[:2])
        if is_purged:
            ledger.purge([schedule.id])
    for schedule, _, _ in history:
        assert ledger.recount(schedule) == []
        assert ledger.counts(LEAGUE).get(schedule.id, 0) == len(ledger.positions(schedule.id))
    for conditions in {schedule.conditions for schedule, _, _ in history}:
        counted = ledger.counted(LEAGUE, conditions)
        matches = [match for schedule in counted for match in ledger.walk(schedule)]
        sums = ledger.sums(LEAGUE, counted)
        assert sums == tally(matches)
        digests = [[game_digest(match, game) for game in match.games] for match in matches]
        texts = ledger.examples(LEAGUE, counted)
        of_pairs = {pair: merged([load_examples(t, name) for name, t in parts]) for pair, parts in texts.items()}
        assert {pair: kinds for pair, kinds in of_pairs.items() if kinds} == examples(matches, digests)
        assert rank_contestants(whole(sums)) == rank_contestants(whole(tally(matches)))
        _check_counted_games(registry, conditions, [schedule for schedule in counted if schedule.sides == TWO])


def _check_counted_games(registry: Registry, conditions: Conditions, counted: list[Schedule]) -> None:
    """With the sides of the league, against the matches one by one."""
    row = registry.leagues.get(LEAGUE)
    played = CountedGames(registry, row, conditions)
    matches = [match for schedule in counted for match in Ledger(registry).walk(schedule)]
    assert (played.matches, played.games) == (len(matches), 2 * len(matches))
    assert played.unique_games == len({game_digest(match, game) for match in matches for game in match.games})
    results = [match.result() for match in matches]
    for standing in played.leaderboard:
        mine = [
            (result, place) for result in results for place in range(2) if result.contestants[place] == standing.ref
        ]
        assert standing.games == sum(result.games for result, _ in mine)
        assert standing.score == sum(result.scores[place] for result, place in mine) / standing.games
        of_ref = (match for match in matches if standing.ref in match.contestants)
        assert standing.unique_games == len({game_digest(match, game) for match in of_ref for game in match.games})
    if (payoff := played.payoff()) is not None:
        assert payoff == tabulate([standing.ref for standing in played.leaderboard], TWO, tally(matches))
    for pair, of_pair in played.sums.items():
        between = [match for match in matches if sorted(match.contestants) == list(pair)]
        assert of_pair.matches == len(between)
        assert of_pair.whole.complete == sum(match.mean_return(0) is not None for match in between)
        for number in range(2):
            alone = [score for match in between for score in _scores_of(match, pair[0], number)]
            of_side = of_pair.sides.get(number, GameSums())
            assert (of_side.played, of_side.points[0]) == (len(alone), sum(alone))


def _scores_of(match: Match, ref: str, side: int) -> list[float]:
    """Scores of a contestant in the games in which it, as first of its name, played a side."""
    contestant = match.contestants.index(ref)
    return [game.scores[contestant] or 0.0 for game in match.games if game.sides[side] == contestant]


def run(history: History) -> None:
    with TemporaryDirectory() as home, closing(registered(Registry.open(Storage.at(Path(home))))) as registry:
        check(registry, history)


@settings(max_examples=20)
@given(histories())
def test_generated_histories(history: History) -> None:
    run(history)


@pytest.mark.slow
@settings(max_examples=1000)
@given(histories())
def test_many_generated_histories(history: History) -> None:
    run(history)
