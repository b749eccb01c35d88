"""Migrations build the current tables, are applied once, and keep the data of version 0.1.0."""

import sqlite3
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from datetime import timedelta
from inspect import unwrap
from pathlib import Path

import psycopg
import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection, inspect, make_url, select, text

from league.errors import StorageError
from league.registry.registry import Registry
from league.registry.storage import database, idempotency, migrations
from league.registry.storage.idempotency import IdempotentCall
from league.registry.storage.rows import Portion
from league.registry.storage.tables import Base
from league.results.ledger import Ledger
from league.settings import Storage
from tests.support.databases import on_both_databases
from tests.support.leagues.ledger_matches import SCHEDULE, play_match
from tests.support.leagues.registries import LEAGUE, interface, publish, traffic_history

pytestmark = on_both_databases


DATA = Path(__file__).parents[4] / "tests" / "data"


@pytest.fixture(autouse=True)
def real_migrations(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the actual migrations in the tests of this module."""
    monkeypatch.setattr(database, "_apply", unwrap(database._apply))


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


def restored(storage: Storage) -> Registry:
    """A registry of version 0.1.0, migrated."""
    url = make_url(storage.database_url)
    dump = (DATA / f"registry-0.1.0-{url.get_backend_name()}.sql").read_text()
    if url.get_backend_name() == "sqlite":
        storage.home.mkdir()
        with closing(sqlite3.connect(str(url.database))) as connection:
            connection.executescript(dump)
    else:
        with psycopg.connect(storage.database_url, autocommit=True) as connection:
            connection.execute(dump.encode())
    return Registry.open(storage)


def test_a_database_of_version_0_1_0_is_migrated_to_the_tables(storage: Storage) -> None:
    with closing(restored(storage)) as registry, registry.database.engine.connect() as connection:
        assert database.revision(connection) == migrations.HEAD
        assert differences(connection) == []
        empty = [
            table.name for table in Base.metadata.sorted_tables if connection.execute(select(table)).first() is None
        ]
    assert empty == ["gateways"], "the database has rows in all tables that version 0.1.0 had"


def test_what_version_0_1_0_wrote_is_read(storage: Storage) -> None:
    with closing(restored(storage)) as registry:
        league = registry.leagues.get(LEAGUE)
        assert (league.config.league, league.interface, league.archived_at) == (LEAGUE, interface(), None)
        assert [game.game["play.opening_plies"] for game in registry.leagues.earlier_games(LEAGUE)] == [4]
        first, second, exploiter, mixture = registry.versions.all(LEAGUE)
        assert (first.aliases, first.note and first.note.text, first.source) == (("champion",), "the first", "run/1000")
        assert (second.parent, second.steps, second.manifest.interface) == (1, 2000, interface())
        assert (exploiter.role, exploiter.exploits) == ("exploiter", "tictactoe@1")
        assert mixture.mixture is not None
        assert [member.probability for member in mixture.mixture.members] == [0.25, 0.75]
        rollback, promotion, start = registry.aliases.history(LEAGUE)
        assert (rollback.kind, rollback.version, start.actor, start.reason) == ("rollback", 1, "ada", "the first")
        verdict = registry.verdicts.get(str(promotion.verdict))
        assert (verdict.outcome, verdict.candidate, verdict.evidence) == ("promote", 2, {"promoted": True, "elo": 42.0})
        assert [(test["kind"], test["ref"]) for test in verdict.tests] == [("anchor", "script:random")]
        assert verdict.tested_schedules == [verdict.schedule, SCHEDULE.id]
        (run,) = registry.nightly_runs.all(LEAGUE)
        assert (run.candidates, run.alpha, run.report) == ((2,), 0.01, {"champion": "tictactoe@2"})
        (night,) = registry.training_nights.all(LEAGUE)
        assert (night.number, night.parent, night.start, night.ended_at is None) == (1, 1, 1, False)
        ledger = Ledger(registry)
        schedule = ledger.schedule(SCHEDULE.id)
        matches = ledger.matches(league=LEAGUE, schedule=schedule.id)
        assert matches == [play_match(schedule, position) for position in range(3)]
        schedules = ledger.schedules(LEAGUE)
        assert sum(of_pair.matches for of_pair in ledger.sums(LEAGUE, schedules).values()) == 6
        assert [ledger.recount(schedule) for schedule in schedules] == [[]] * len(schedules), (
            "the sums are those of its matches"
        )
        (key,) = registry.keys.all()
        assert (key.name, key.scopes, key.leagues, key.rate) == ("ci", {"read", "promote"}, {LEAGUE}, 20)
        (setting,) = traffic_history(registry)
        assert (setting.canary, setting.shadow) == (Portion(2, 0.25), Portion("candidate", 0.5))
        (counts,) = registry.traffic.shadow_counts(LEAGUE)
        assert (counts.agreement, counts.latency[:3]) == (0.75, [1, 2, 3])
        evaluation = registry.evaluations.get(LEAGUE, 1)
        assert (evaluation.state, evaluation.request["blocks"], evaluation.result) == ("done", 2, {"matches": 4})
        training = registry.runs.get(LEAGUE, "run")
        assert (training.state, training.target, training.curves) == ("ended", 2000, {"return": 0.5})
        assert [point.curves for point in registry.runs.points(LEAGUE, "run")] == [{"return": 0.25}, {"return": 0.5}]
        assert [stored.record for stored in registry.runs.stored(LEAGUE)] == [{"git_commit": None}]
        (strength,) = registry.strength.of_run(LEAGUE, "run")
        assert (strength.version, strength.opponent, strength.score) == (2, "tictactoe@1", 0.75)
        assert [(row.replica, row.version) for row in registry.replicas.acknowledgements(LEAGUE)] == [
            ("replica-1", 1),
            ("replica-2", 1),
        ]


def test_a_registry_of_version_0_1_0_continues(storage: Storage, monkeypatch: pytest.MonkeyPatch) -> None:
    """Numbers and ids follow those of its rows, and a repeated call gets its result."""
    monkeypatch.setattr(idempotency, "KEPT", timedelta(days=36_500))  # its calls were made in 2026
    with closing(restored(storage)) as registry:
        assert publish(registry, "run/3000", parent=2).number == 5
        owner = registry.keys.all()[0].id
        repeated = IdempotentCall(owner=owner, key="a", digest="a" * 64)
        event = registry.aliases.set(LEAGUE, "champion", 1, expected=None, actor="ada", reason="again", call=repeated)
        assert (event.id, event.reason) == (1, "the first")
        assert registry.aliases.set(LEAGUE, "champion", 5, expected=1, actor="ada", reason="better").id == 5
        assert registry.aliases.rollback(LEAGUE, actor="ada", reason="worse").version == 1
        assert registry.training_nights.open(LEAGUE).number == 2


def differences(connection: Connection) -> list[object]:
    """From the tables of the classes."""
    return list(compare_metadata(MigrationContext.configure(connection, opts={"compare_type": True}), Base.metadata))


def test_migrations_build_the_tables(empty: Registry, storage: Storage) -> None:
    with empty.database.engine.connect() as connection:
        assert differences(connection) == []
        # compare_metadata ignores the condition of a partial index.
        indexes = {index["name"]: index for index in inspect(connection).get_indexes("versions")}
        where = indexes["uq_versions_ready_source"]["dialect_options"]
        assert any("state" in str(condition) and "ready" in str(condition) for condition in where.values())
        connection.exec_driver_sql("UPDATE alembic_version SET version_num = '9999'")
        connection.commit()
    with pytest.raises(StorageError, match="9999 of another release"):
        Registry.open(storage)
