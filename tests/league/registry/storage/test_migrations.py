"""Migrations build the current tables and are applied once."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from inspect import unwrap
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from alembic.operations import Operations
from alembic.script import ScriptDirectory
from sqlalchemy import inspect, text
from sqlalchemy.exc import IntegrityError

from league.errors import ConfigError, StorageError
from league.registry.registry import Registry
from league.registry.storage import database, migrations
from league.registry.storage.database import Database
from league.registry.storage.rows import RunPoint
from league.registry.storage.tables import Base
from league.results.ledger import Ledger
from league.settings import Storage
from tests.support.leagues.ledger_matches import SCHEDULE, play_match
from tests.support.leagues.registries import LEAGUE, registered


@pytest.fixture(autouse=True)
def real_migrations(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the actual migrations in the tests of this module."""
    monkeypatch.setattr(database, "_apply", unwrap(database._apply))


def test_migrations_build_the_tables(empty: Registry) -> None:
    with empty.database.engine.connect() as connection:
        context = MigrationContext.configure(connection, opts={"compare_type": True})
        assert compare_metadata(context, Base.metadata) == []
        # compare_metadata ignores the condition of a partial index.
        indexes = {index["name"]: index for index in inspect(connection).get_indexes("versions")}
        where = indexes["uq_versions_ready_source"]["dialect_options"]
    assert any("state" in str(condition) and "ready" in str(condition) for condition in where.values())


def test_known_revisions_are_those_of_the_directory() -> None:
    assert migrations.__file__ is not None
    script = ScriptDirectory(str(Path(migrations.__file__).parent))
    assert [revision.revision for revision in script.walk_revisions()][::-1] == list(migrations.KNOWN)


def test_concurrent_opening_migrates_once(storage: Storage) -> None:
    with ThreadPoolExecutor(8) as pool:
        registries = list(pool.map(lambda _: Registry.open(storage), range(8)))
    with registries[0].database.engine.connect() as connection:
        assert connection.execute(text("SELECT version_num FROM alembic_version")).all() == [(migrations.HEAD,)]
    for registry in registries:
        assert registry.leagues.names() == {}
        registry.close()


def test_reopening_keeps_the_data(registry: Registry, storage: Storage) -> None:
    again = Registry.open(storage)
    assert again.leagues.names() == registry.leagues.names()
    again.close()


def test_a_newer_schema_is_rejected(empty: Registry, storage: Storage) -> None:
    with empty.database.engine.connect() as connection:
        connection.exec_driver_sql("UPDATE alembic_version SET version_num = '9999'")
        connection.commit()
    with pytest.raises(StorageError, match="9999 of a newer release"):
        Registry.open(storage)


def test_a_failed_migration_is_rolled_back(storage: Storage, monkeypatch: pytest.MonkeyPatch) -> None:
    from alembic import op

    create = op.create_table

    def break_at_aliases(name: str, *columns: object) -> object:
        if name == "aliases":
            raise RuntimeError("power cut")
        return create(name, *columns)

    monkeypatch.setattr(op, "create_table", break_at_aliases)
    with pytest.raises(RuntimeError, match="power cut"):
        Registry.open(storage)
    monkeypatch.undo()
    registry = Registry.open(storage)
    assert registry.leagues.names() == {}
    registry.close()


def test_the_budgets_and_points_of_old_runs_are_kept(storage: Storage) -> None:
    registry = registered(Registry.open(storage), versions=1)
    begin = partial(registry.runs.begin, LEAGUE, algorithm="ppo", settings={}, seed=1)
    begin("old", target=1000)
    registry.runs.record(LEAGUE, "old", RunPoint(10, {"return": 0.5}, datetime.now(UTC)))
    with registry.database.engine.execution_options(writes=True).begin() as connection:
        # As revision 0013 left it.
        connection.execute(text("ALTER TABLE runs ADD COLUMN old BIGINT NOT NULL DEFAULT 1000"))
        connection.execute(text("ALTER TABLE runs DROP COLUMN target"))
        connection.execute(text("ALTER TABLE runs RENAME COLUMN old TO target"))
        connection.execute(text("ALTER TABLE leagues DROP COLUMN archived_at"))
        for column in ("exploits", "driver", "record"):
            connection.execute(text(f"ALTER TABLE runs DROP COLUMN {column}"))
        for table in ("earlier_games", "strengths", "change_counter"):
            connection.execute(text(f"DROP TABLE {table}"))
        connection.execute(text("DROP INDEX ix_replicas_seen_at"))
        for column in ("event", "traffic", "changes"):
            connection.execute(text(f"ALTER TABLE replicas DROP COLUMN {column}"))
        connection.execute(text("UPDATE alembic_version SET version_num = '0013'"))
    with pytest.raises(IntegrityError), registry.database.engine.begin() as connection:
        connection.execute(text("UPDATE runs SET target = NULL"))
    registry.close()
    upgraded = Registry.open(storage)
    assert upgraded.runs.get(LEAGUE, "old").target == 1000
    assert [point.steps for point in upgraded.runs.points(LEAGUE, "old")] == [10]
    new = upgraded.runs.begin(LEAGUE, "new", algorithm="ppo", settings={}, seed=1, target=None)
    assert upgraded.runs.get(LEAGUE, "new") == new
    assert new.target is None
    upgraded.close()


def test_old_matches_are_found_by_contestant(storage: Storage) -> None:
    """A ledger of an earlier release identifies the contestants of matches only by the schedule."""
    registry = registered(Registry.open(storage), versions=1)
    ledger = Ledger(registry)
    schedules = [SCHEDULE, replace(SCHEDULE, id="later", kind="gauntlet", contestants=SCHEDULE.contestants[::-1])]
    for schedule in schedules:
        ledger.open(schedule)
        ledger.extend([play_match(schedule, position) for position in (0, 2, 4)])
    ledger.open(replace(SCHEDULE, id="never-played"))
    expected = ledger.page(LEAGUE)
    with registry.database.engine.execution_options(writes=True).begin() as connection:
        operations = Operations(MigrationContext.configure(connection))
        for index in ("ix_matches_league_played_at", "ix_matches_league_first_second_played_at"):
            operations.drop_index(index, "matches")
        added = {
            "schedules": ("kind",),
            "matches": ("league", "first", "second"),
            "acknowledgements": ("event",),
            "versions": ("retired_at", "role", "exploits"),
            "leagues": ("game", "game_digest", "archived_at"),
        }
        for table, columns in added.items():
            for column in columns:
                operations.drop_column(table, column)
        for table in (
            "snapshots",
            "run_points",
            "runs",
            "version_notes",
            "replicas",
            "training_nights",
            "strengths",
            "earlier_games",
            "change_counter",
        ):
            operations.drop_table(table)
        connection.execute(text("UPDATE alembic_version SET version_num = '0005'"))
    registry.close()
    upgraded = Registry.open(storage)
    assert Ledger(upgraded).page(LEAGUE) == expected
    row = upgraded.leagues.get(LEAGUE)
    assert row.game_digest == row.environment_digest
    assert Ledger(upgraded).page(LEAGUE, contestants=("script:random", "tictactoe@1"), limit=1) == expected[:1]
    upgraded.aliases.set(LEAGUE, "champion", 1, expected=None, actor="test", reason="its role is main")
    upgraded.close()


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("mysql://host/league", "names 'mysql': expected sqlite or postgresql"),
        ("no url at all: secret", "LEAGUE_DATABASE_URL is not a URL: expected sqlite"),
        ("sqlite://", "does not name a file"),
        ("sqlite:///:memory:", "does not name a file"),
    ],
)
def test_an_unsupported_url_is_reported(url: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Database(url)


def test_an_unreachable_server_is_reported_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(StorageError) as caught:
        Database(f"postgresql://somebody:secret@/league?host={tmp_path}")
    assert "\n" not in str(caught.value)
    assert "secret" not in str(caught.value)


def test_a_file_that_is_not_a_database_is_reported_in_one_line(tmp_path: Path) -> None:
    storage = Storage.at(tmp_path)
    (tmp_path / "league.db").write_text("these are not the bytes of a database, however long they go on " * 100)
    with pytest.raises(StorageError, match=r"league\.db cannot be used: file is not a database"):
        Registry.open(storage)
