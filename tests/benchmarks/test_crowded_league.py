"""The simulated league is consistent: its games can be replayed, and its records agree."""

from contextlib import closing
from pathlib import Path

import pytest

from benchmarks.leagues.crowded_league import LEAGUE, crowd
from evaluation.gating.verification import verify
from league.results.ledger import Ledger

pytestmark = pytest.mark.slow  # it plays 1,500 matches


def test_games_can_be_replayed_and_records_agree(tmp_path: Path) -> None:
    with closing(crowd(tmp_path, versions=6, matches=1500)) as registry:
        verdicts = registry.verdicts.newest(LEAGUE)
        assert [verdict.candidate for verdict in verdicts] == [6, 5, 4, 3, 2, 1]
        assert [verify(verdict.id, registry=registry, replays=6).replayed for verdict in verdicts] == [6] * 6
        ledger = Ledger(registry)
        assert 1500 <= sum(ledger.counts(LEAGUE).values()) < 1600
        entries = ledger.page(LEAGUE, limit=2000)
        assert {entry.kind for entry in entries} == {"verdict", "gauntlet", "round_robin"}
        assert entries[0].kind == "round_robin"
        assert registry.aliases.history(LEAGUE), "no version was promoted"
        assert registry.snapshots.stale() == []
        assert {run.state for run in registry.runs.newest(LEAGUE)} >= {"ended", "failed", "stopped"}
