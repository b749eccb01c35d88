"""The ledger accepts the matches of its schedules, each once, and returns them exactly."""

import math
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from sqlalchemy import delete, update

from league.errors import InvalidInput, LedgerConflict, NotFound, OutOfSpace
from league.registry.registry import Registry
from league.registry.storage import tables
from league.results import ledger as ledger_module
from league.results.ledger import Ledger
from league.results.records import (
    BlockResult,
    Forfeit,
    Game,
    LedgerEntry,
    Match,
    Schedule,
    dump_games,
    dump_schedule,
    load_games,
    load_schedule,
)
from league.results.sums import GameSums, whole
from league.settings import Storage
from tests.support.databases import on_both_databases
from tests.support.leagues.ledger_matches import SCHEDULE, game, play_match
from tests.support.leagues.registries import LEAGUE, registered
from tests.support.mounts import small_disk


@pytest.fixture
def ledger(storage: Storage) -> Iterator[Ledger]:
    registry = registered(Registry.open(storage))
    yield Ledger(registry)
    registry.close()


def test_the_size_of_a_schedule_is_limited(ledger: Ledger, storage: Storage, monkeypatch: pytest.MonkeyPatch) -> None:
    ledger.open(SCHEDULE)
    size = len(dump_games(play_match(SCHEDULE, 0).games))
    monkeypatch.setattr(ledger_module, "MOST_BYTES", 3 * size + size // 2)
    ledger.extend([play_match(SCHEDULE, position) for position in range(2)])
    again = Ledger(Registry.open(storage))  # after a restart
    assert again.extend([play_match(SCHEDULE, 2)])
    with pytest.raises(OutOfSpace, match="recorded games of schedule"):
        again.extend([play_match(SCHEDULE, 3)])
    assert ledger.positions(SCHEDULE.id) == {0, 1, 2}
    other = replace(SCHEDULE, id="of another evaluation")
    ledger.open(other)
    assert ledger.extend([play_match(other, 0)])


def test_games_leave_space_on_the_disk_of_the_database(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", megabytes=2) as disk:
        registry = registered(Registry.open(Storage(disk, f"sqlite:///{disk}/league.db", disk / "artifacts")))
        ledger = Ledger(registry)
        ledger.open(SCHEDULE)
        with pytest.raises(OutOfSpace, match=r"[01] MB are free on the disk of .*: games are recorded only"):
            ledger.extend([play_match(SCHEDULE, 0)])
        registry.keys.create("other-changes-go-on", ["act"])
        registry.close()


@on_both_databases
def test_results_are_sums_over_blocks(ledger: Ledger) -> None:
    other = replace(SCHEDULE, id="of another game", game_digest="0" * 64)
    for schedule in (other, SCHEDULE):
        ledger.open(schedule)
        ledger.extend([play_match(schedule, position) for position in (2, 1)])
    assert ledger.counted(LEAGUE, SCHEDULE.conditions) == [SCHEDULE]
    assert ledger.counted(LEAGUE, other.conditions) == [other]
    assert ledger.counted(LEAGUE, SCHEDULE.conditions._replace(actions="sampled")) == []
    pair = ("script:random", "tictactoe@1")
    of_pair = GameSums(Counter({(2, 1, 3): 1}), 1, 2, (-0.75, 1.25), -1, 1)  # type: ignore[arg-type]
    assert whole(ledger.sums(LEAGUE, [SCHEDULE], between=pair)) == {pair: of_pair}
    assert whole(ledger.sums(LEAGUE, [SCHEDULE])) == {pair: of_pair, ("script:random", "tictactoe@2"): of_pair}
    assert ledger.sums(LEAGUE, [SCHEDULE, other])[pair].matches == 2


def test_a_block_with_a_forfeit_has_scores_but_no_returns(ledger: Ledger) -> None:
    ledger.open(SCHEDULE)
    first, second = play_match(SCHEDULE, 0).games
    lost = replace(first, scores=(0.0, 1.0), forfeits=(Forfeit(0, "player_1", "illegal_action"),))
    match = SCHEDULE.match(0, (lost, second))
    ledger.extend([match])
    assert ledger.matches(league=LEAGUE) == [match]
    sums = ledger.sums(LEAGUE, [SCHEDULE])["tictactoe@1", "tictactoe@2"].whole
    assert (sums.points, sums.played, sums.complete) == ((0.5, 1.5), 2, 0)
    assert match.result() == BlockResult(SCHEDULE.id, 0, match.contestants, 2, (0.5, 1.5), None)
    assert match.mean_return(0) is None


def entry(schedule: Schedule, position: int) -> tuple[str, BlockResult, str]:
    return schedule.match_id(position), play_match(schedule, position).result(), schedule.kind


def summarized(entries: list[LedgerEntry]) -> list[tuple[str, BlockResult, str]]:
    return [(entry.id, entry.result, entry.kind) for entry in entries]


def test_matches_are_listed_newest_first(ledger: Ledger) -> None:
    other = replace(SCHEDULE, id="a-gauntlet", kind="gauntlet")
    for schedule in (SCHEDULE, other):
        ledger.open(schedule)
    order = [(other, 4), (SCHEDULE, 0), (other, 1), (SCHEDULE, 7), (SCHEDULE, 2)]
    for schedule, position in order:
        ledger.extend([play_match(schedule, position)])
    expected = [entry(*listed) for listed in reversed(order)]
    page = ledger.page(LEAGUE, limit=2)
    assert summarized(page) == expected[:2]
    assert page[0].played_at > page[1].played_at
    assert not page[0].is_purged
    assert summarized(ledger.page(LEAGUE, before=page[-1].id)) == expected[2:]
    assert ledger.page(LEAGUE, before=expected[-1][0]) == []
    ledger.purge([other.id])
    assert [entry.is_purged for entry in ledger.page(LEAGUE)] == [False, False, True, False, True]


def test_matches_of_a_pair_are_listed_in_either_order(ledger: Ledger) -> None:
    reverse = replace(SCHEDULE, id="turned", contestants=SCHEDULE.contestants[::-1])
    for schedule in (SCHEDULE, reverse):
        ledger.open(schedule)
        ledger.extend([play_match(schedule, position) for position in range(9)])
    # Of the pairings (0, 1), (0, 2), (1, 2), versions 1 and 2 are the first one, and the last one in reverse order.
    expected = [entry(reverse, position) for position in (8, 5, 2)] + [entry(SCHEDULE, at) for at in (6, 3, 0)]
    assert {listed[1].contestants for listed in expected} == {
        ("tictactoe@1", "tictactoe@2"),
        ("tictactoe@2", "tictactoe@1"),
    }
    for first, second in (("tictactoe@1", "tictactoe@2"), ("tictactoe@2", "tictactoe@1")):
        assert summarized(ledger.page(LEAGUE, contestants=(first, second))) == expected
        page = ledger.page(LEAGUE, contestants=(first, second), before="turned/5", limit=2)
        assert summarized(page) == expected[2:4]
    assert ledger.page(LEAGUE, contestants=("tictactoe@1", "tictactoe@1")) == []


def test_a_contestant_that_plays_with_itself_is_listed_once(ledger: Ledger) -> None:
    schedule = replace(SCHEDULE, id="team", kind="cross_play", scoring="team", pairings=((0, 0), (0, 1), (1, 1)))
    ledger.open(schedule)
    for position in range(3):
        games = tuple(replace(game(schedule, position, i), scores=(None, None)) for i in range(2))
        ledger.extend([schedule.match(position, games)])
    (entry_of_match,) = ledger.page(LEAGUE, contestants=("tictactoe@2", "tictactoe@2"))
    assert (entry_of_match.id, entry_of_match.result.contestants) == ("team/2", ("tictactoe@2", "tictactoe@2"))


def test_a_schedule_is_read_in_strides(ledger: Ledger, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ledger_module, "STRIDE", 3)
    for schedule in (SCHEDULE, replace(SCHEDULE, id="another")):
        ledger.open(schedule)
    for positions in ([], [0, 1, 3], [0, 1, 3, 4, 5, 6, 8]):
        ledger.extend([play_match(SCHEDULE, position) for position in positions])
        assert list(ledger.walk(SCHEDULE)) == [play_match(SCHEDULE, position) for position in positions]
    assert ledger.counts(LEAGUE) == {SCHEDULE.id: 7}


def test_a_match_is_found_without_its_moves(ledger: Ledger) -> None:
    ledger.open(SCHEDULE)
    ledger.extend([play_match(SCHEDULE, 1)])
    assert ledger.page(LEAGUE) == [ledger.entry(SCHEDULE.match_id(1))]
    for name in (SCHEDULE.match_id(2), "nothing/1", "nothing", f"{SCHEDULE.id}/{10**30}", f"{SCHEDULE.id}/-1"):
        with pytest.raises(NotFound):
            ledger.entry(name)
        with pytest.raises(NotFound):
            ledger.match(name)
        with pytest.raises(InvalidInput, match="before: league tictactoe has no match"):
            ledger.page(LEAGUE, before=name)


def solo_match(schedule: Schedule, position: int, *returns: float) -> Match:
    """A block in which each contestant plays a game alone."""
    first, second = returns
    score = 1.0 if first > second else 0.0
    games = (
        Game((0,), schedule.seed_at(position), (), (1,), (first, None), (score, None)),
        Game((1,), schedule.seed_at(position), (), (2,), (None, second), (None, 1 - score)),
    )
    return schedule.match(position, games)


CRASH = Forfeit(0, "player_2", "crashed")


def of_game(**changes: Any) -> Callable[[Match], Match]:
    """Change the second game."""
    return lambda match: replace(match, games=(match.games[0], replace(match.games[1], **changes)))


def of_match(**changes: Any) -> Callable[[Match], Match]:
    return lambda match: replace(match, **changes)


REJECTED: list[tuple[Callable[[Match], Match], str]] = [
    (of_match(position=9), "ends before position 9"),
    (of_match(position=-1), "ends before position 9"),
    (of_match(id="x/1"), "its id is 'x/1'"),
    (of_match(league="chess"), "its league is 'chess'"),
    (of_match(contestants=("tictactoe@1", "tictactoe@9")), "its contestants is .*tictactoe@9"),
    (of_match(contestants=("tictactoe@1", "tictactoe@2")), "its contestants is"),  # others of the schedule
    (of_match(seed=SCHEDULE.seed_at(2)), "its seed is"),  # of another block
    (of_match(environment_digest="0" * 64), "its environment_digest is"),
    (of_match(games=()), "has 0 games, expected 2"),
    (lambda match: replace(match, games=match.games[:1]), "has 1 games"),
    (of_game(sides=(0, 1)), "game 1 has its sides played by .0, 1., expected .1, 0."),
    (of_game(seed=5), "game 1 has the seed 5"),
    (of_game(opening=(0, 1)), "game 1 has another opening"),
    (
        lambda match: replace(match, games=tuple(replace(game, opening=(1,)) for game in match.games)),
        "game 0 has another opening than the block's 2 steps",
    ),
    (of_game(returns=(math.inf, 0.0)), "game 1 needs a finite return"),
    (of_game(returns=(None, 0.25)), "game 1 needs a finite"),
    (of_game(scores=(1.0, 0.0)), r"returns say \(0\.5, 0\.5\)"),
    (of_game(scores=(math.nan, 1.0)), "game 1 has the scores"),
    (of_game(forfeits=(CRASH,)), r"forfeits say \(0\.0, 1\.0\)"),
    (of_game(forfeits=(CRASH, CRASH), scores=(0.0, 1.0)), "game 1 has two forfeits"),
    (of_game(forfeits=(replace(CRASH, contestant=2),)), "forfeited by contestant 2, which did not play it"),
    (of_game(forfeits=(replace(CRASH, reason="tired"),), scores=(0.0, 1.0)), "unknown reason: 'tired'"),
]


def test_a_match_that_contradicts_its_schedule_is_rejected(ledger: Ledger, subtests: pytest.Subtests) -> None:
    with pytest.raises(NotFound, match="there is no schedule 'tictactoe-round_robin-1'"):
        ledger.extend([play_match(SCHEDULE, 0)])
    ledger.open(SCHEDULE)
    for number, (change, message) in enumerate(REJECTED):
        with subtests.test(number=number, message=message), pytest.raises(LedgerConflict, match=message):
            ledger.extend([change(play_match(SCHEDULE, 1))])
    assert ledger.matches(league=LEAGUE) == []


numbers = st.floats(allow_nan=False, allow_infinity=False)


boxes = st.lists(st.floats(width=32, allow_nan=False, allow_infinity=False), max_size=3)


actions = st.one_of(
    st.integers(-(2**63), 2**63 - 1),
    st.lists(st.integers(-(2**63), 2**63 - 1), max_size=3),
    st.lists(numbers, max_size=3),
    boxes,
    st.lists(boxes, max_size=2),
)


@st.composite
def blocks(draw: Any) -> tuple[Game, ...]:
    seed, opening = draw(st.integers(0, 2**63 - 1)), tuple(draw(st.lists(actions, max_size=3)))
    return tuple(
        Game(
            sides=(index, 1 - index),
            seed=seed,
            opening=opening,
            actions=tuple(draw(st.lists(actions, max_size=5))),
            returns=tuple(draw(st.lists(st.none() | numbers, min_size=2, max_size=2))),
            scores=(0.5, None),
        )
        for index in range(2)
    )


@given(blocks(), st.integers(0, 2**63 - 1))
def test_games_and_schedules_survive_serialization(games: tuple[Game, ...], seed: int) -> None:
    assert load_games(dump_games(games)) == games
    schedule = replace(SCHEDULE, seed=seed)
    assert load_schedule(dump_schedule(schedule)) == schedule


@on_both_databases
def test_sums_that_differ_from_the_matches_are_found_and_replaced(ledger: Ledger, storage: Storage) -> None:
    ledger.open(SCHEDULE)
    ledger.extend([play_match(SCHEDULE, position) for position in (0, 1, 4)])
    before = ledger.sums(LEAGUE, [SCHEDULE])
    with Registry.open(storage).database.write() as session:
        session.execute(delete(tables.PairSumTable).filter_by(first="tictactoe@1"))
        session.execute(update(tables.ScheduleTotalTable).values(matches=7))
    expected = [f"schedule_totals of {SCHEDULE.id}", "pair_sums of tictactoe@1 tictactoe@2"]
    assert ledger.recount(SCHEDULE, mend=False) == expected
    assert ledger.recount(SCHEDULE) == expected
    assert ledger.recount(SCHEDULE) == []
    assert ledger.sums(LEAGUE, [SCHEDULE]) == before
    assert ledger.counts(LEAGUE) == {SCHEDULE.id: 3}


@on_both_databases
def test_matches_are_stored_once_and_returned_exactly_in_schedule_order(ledger: Ledger) -> None:
    assert ledger.open(SCHEDULE) == SCHEDULE
    assert ledger.open(replace(SCHEDULE, length=5)) == SCHEDULE
    second = replace(SCHEDULE, id="a-later-one")
    ledger.open(second)
    assert ledger.schedules(LEAGUE) == [SCHEDULE, second]
    for position in (4, 0, 2):
        assert ledger.extend([play_match(SCHEDULE, position)]) == 1
    match = play_match(SCHEDULE, 4)
    other_moves = replace(match, games=tuple(replace(game, actions=(8,)) for game in match.games))
    assert (ledger.extend([match]), ledger.extend([other_moves])) == (0, 0)
    expected = [play_match(SCHEDULE, position) for position in (0, 2, 4)]
    assert ledger.matches(league=LEAGUE) == expected
    assert ledger.matches(league=LEAGUE, schedule=SCHEDULE.id) == expected
    assert ledger.matches(league=LEAGUE, schedule="another") == []
    assert ledger.positions("another") == set()
    assert ledger.extend([]) == 0
    assert ledger.extend([play_match(SCHEDULE, position) for position in range(3)]) == 1
    with pytest.raises(LedgerConflict):
        ledger.extend([play_match(SCHEDULE, 3), replace(play_match(SCHEDULE, 5), seed=1)])
    assert ledger.positions(SCHEDULE.id) == {0, 1, 2, 4}, "several are stored together or not at all"


def test_a_block_of_solo_games_is_one_comparison(ledger: Ledger) -> None:
    schedule = replace(SCHEDULE, sides=("team",), scoring="side", opening_plies=0)
    ledger.open(schedule)
    played = [solo_match(schedule, 0, 3.5, 2.0), solo_match(schedule, 1, 3.5, 4.0)]
    ledger.extend(played)
    won, lost = ledger.matches(league=LEAGUE)
    assert [won, lost] == played
    assert (won.score(0), won.score(1), lost.score(0)) == (1.0, 0.0, 0.0)
    assert (won.mean_return(0), won.mean_return(1)) == (3.5, 2.0)
    sums = whole(ledger.sums(LEAGUE, [schedule])).values()
    assert [(of_pair.points, of_pair.played) for of_pair in sums] == [((1.0, 0.0), 1), ((1.0, 0.0), 1)]
    assert won.result() == BlockResult(schedule.id, 0, won.contestants, 1, (1.0, 0.0), (3.5, 2.0))
    match = solo_match(schedule, 2, 3.5, 2.0)
    both = replace(match.games[0], returns=(3.5, 2.0), scores=(1.0, 0.0))
    with pytest.raises(LedgerConflict, match="finite return of each contestant that played"):
        ledger.extend([replace(match, games=(both, match.games[1]))])
