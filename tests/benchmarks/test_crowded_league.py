"""The simulated league is consistent: its games can be replayed, and its records agree."""

from collections.abc import Iterator

import pytest

from evaluation.gating.verification import verify
from league.registry.registry import Registry
from league.results.ledger import Ledger
from tests.support.leagues.crowded_league import LEAGUE, crowd

pytestmark = pytest.mark.slow  # it plays 1,500 matches


@pytest.fixture(scope="module")
def registry(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Registry]:
    opened = crowd(tmp_path_factory.mktemp("home"), versions=6, matches=1500)
    yield opened
    opened.close()


def test_all_verdicts_are_verified_by_replay(registry: Registry) -> None:
    verdicts = registry.verdicts.all(LEAGUE)
    assert len(verdicts) == 6
    for verdict in verdicts:
        assert verify(verdict.id, registry=registry, replays=6).replayed == 6


def test_it_has_the_requested_number_of_matches_in_nightly_runs(registry: Registry) -> None:
    ledger = Ledger(registry)
    assert 1500 <= sum(ledger.counts(LEAGUE).values()) < 1600
    entries = ledger.page(LEAGUE, limit=2000)
    assert {entry.kind for entry in entries} == {"verdict", "gauntlet", "round_robin"}
    assert entries[0].kind == "round_robin"
    assert [verdict.candidate for verdict in registry.verdicts.newest(LEAGUE)] == [6, 5, 4, 3, 2, 1]
    assert registry.aliases.history(LEAGUE), "no version was promoted"


def test_its_snapshots_are_up_to_date(registry: Registry) -> None:
    assert registry.snapshots.stale() == []
    assert {run.state for run in registry.runs.newest(LEAGUE)} >= {"ended", "failed", "stopped"}
