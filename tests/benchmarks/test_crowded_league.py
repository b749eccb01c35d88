"""The crowded league is one that could have come about: its games can be replayed, and its records agree."""

from collections.abc import Iterator

import pytest

from benchmarks.crowded_league import LEAGUE, crowd
from evaluation.verification import verify
from league.registry.registry import Registry
from league.results.ledger import Ledger


@pytest.fixture(scope="module")
def registry(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Registry]:
    opened = crowd(tmp_path_factory.mktemp("home"), versions=6, matches=1500)
    yield opened
    opened.close()


def test_every_verdict_holds_when_it_is_computed_again_and_its_games_are_replayed(registry: Registry) -> None:
    verdicts = registry.verdicts(LEAGUE)
    assert len(verdicts) == 6
    for verdict in verdicts:
        assert verify(verdict.id, registry=registry, replays=6).replayed == 6


def test_it_has_as_many_matches_as_were_asked_for_one_night_after_the_other(registry: Registry) -> None:
    ledger = Ledger(registry)
    assert 1500 <= sum(ledger.counts(LEAGUE).values()) < 1600
    entries = ledger.page(LEAGUE, limit=2000)
    assert {entry.kind for entry in entries} == {"verdict", "gauntlet", "round_robin"}
    assert entries[0].kind == "round_robin"
    assert [verdict.candidate for verdict in registry.newest_verdicts(LEAGUE)] == [6, 5, 4, 3, 2, 1]
    assert registry.history(LEAGUE), "somebody was promoted"


def test_its_snapshots_are_up_to_date(registry: Registry) -> None:
    assert registry.stale_snapshots() == []
    assert {run.state for run in registry.runs(LEAGUE)} >= {"ended", "failed", "stopped"}
