"""Retention: files that nothing needs are removed, all others stay."""

from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from sqlalchemy import update

from league.errors import VersionRetired
from league.registry.registry import Registry
from league.registry.storage.manifest import TRAINING
from league.registry.storage.rows import Portion
from league.registry.storage.tables import VersionTable
from league.results.ledger import Ledger
from league.results.records import Schedule
from league.settings import Storage
from tests.support.leagues.ledger_matches import SCHEDULE
from tests.support.leagues.registries import LEAGUE, publish, registered, verified
from tests.support.templates import copy_of

MONTH = timedelta(days=30)


@pytest.fixture
def versions(storage: Storage) -> Iterator[Registry]:
    """Six versions that are a year old."""
    registry = copy_of(league_of_six, storage)
    yield registry
    registry.close()


def league_of_six(storage: Storage) -> Registry:
    registry = registered(Registry.open(storage), versions=6)
    with registry.database.write() as session:
        session.execute(update(VersionTable).values(reserved_at=datetime.now(UTC) - timedelta(days=365)))
    return registry


def schedule_of(*contestants: str) -> Schedule:
    return replace(SCHEDULE, league=LEAGUE, contestants=contestants)


def retire(registry: Registry, keep: int = 1) -> tuple[set[int], set[int]]:
    removal = registry.retention.retire(LEAGUE, keep=keep, before=datetime.now(UTC) - MONTH)
    return set(removal.versions), set(removal.training)


def has_training(registry: Registry, number: int) -> bool:
    return (registry.artifacts.path(LEAGUE, number) / TRAINING).exists()


def test_needed_versions_keep_their_policies(versions: Registry, tmp_path: Path) -> None:
    for number in (1, 2):
        versions.aliases.set(LEAGUE, "champion", number, expected=None if number == 1 else 1, actor="me", reason="")
    versions.traffic.set(LEAGUE, shadow=Portion(3, 1.0), actor="me", reason="")
    Ledger(versions).open(schedule_of(f"{LEAGUE}@4", "script:random"))
    assert retire(versions) == ({5}, {1, 3, 4})
    assert [has_training(versions, number) for number in range(1, 7)] == [False, True, False, False, False, True]
    for number in (1, 2, 3, 4, 6):
        assert verified(versions, number)
    with pytest.raises(VersionRetired, match=f"{LEAGUE}@4 has no training state any more"):
        versions.versions.copy(LEAGUE, 4, TRAINING, tmp_path / "start")
    assert retire(versions) == (set(), set()), "nothing is left to remove"


def test_new_versions_and_those_of_open_tests_stay(versions: Registry) -> None:
    publish(versions, "run/7")
    versions.nightly_runs.open(LEAGUE, [2], alpha=0.05)
    versions.verdicts.open(LEAGUE, 3, f"{LEAGUE}@4", "verdict", {})
    assert retire(versions, keep=2) == ({1, 5}, {2, 3, 4})


def test_a_void_verdict_and_purged_games_need_nothing(versions: Registry) -> None:
    Ledger(versions).open(plan := schedule_of(f"{LEAGUE}@1", f"{LEAGUE}@2"))
    versions.verdicts.open(LEAGUE, 3, f"{LEAGUE}@4", "verdict", {})
    versions.verdicts.void("verdict", "a mistake")
    Ledger(versions).purge([plan.id])
    assert retire(versions, keep=2) == ({1, 2, 3, 4}, set())


def test_an_interrupted_removal_is_completed(versions: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    versions.aliases.set(LEAGUE, "champion", 1, expected=None, actor="me", reason="")
    versions.aliases.set(LEAGUE, "champion", 2, expected=1, actor="me", reason="")

    def fail(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("shutil.rmtree", fail)
        with pytest.raises(KeyboardInterrupt):
            retire(versions)
    assert versions.versions.all(LEAGUE)[4].retired_at is not None
    assert retire(versions) == ({3, 4, 5}, {1})
    assert [path.name for path in sorted((versions.artifacts.root / LEAGUE).iterdir())] == ["1", "2", "6"]


def test_no_version_is_retired_while_its_league_is_trained(versions: Registry) -> None:
    """Any version may be an opponent. The training state of opponents is not needed."""
    versions.runs.begin(LEAGUE, "run", algorithm="ppo", settings={}, seed=0, target=100)
    assert retire(versions) == (set(), {1, 2, 3, 4, 5})
    versions.runs.end(LEAGUE, "run", "ended")
    assert retire(versions)[0] == {1, 2, 3, 4, 5}


def test_a_retired_version_is_listed_but_cannot_be_used(versions: Registry) -> None:
    plan = versions.retention.plan(LEAGUE, keep=1, before=datetime.now(UTC))
    assert plan.size == sum(versions.artifacts.size(LEAGUE, number) for number in range(1, 6)) > 0
    assert all(row.retired_at is None for row in versions.versions.all(LEAGUE))
    assert retire(versions)[0] == set(plan.versions) == {1, 2, 3, 4, 5}
    for use in (
        lambda: verified(versions, 2),
        lambda: versions.aliases.set(LEAGUE, "champion", 2, expected=None, actor="me", reason=""),
        lambda: versions.traffic.set(LEAGUE, canary=Portion(2, 0.5), actor="me", reason=""),
    ):
        with pytest.raises(VersionRetired, match=f"{LEAGUE}@2 was retired"):
            use()
    assert publish(versions, "run/7").number == 7
    assert retire(versions, keep=0) == ({6}, set()), "version 7 is young"
