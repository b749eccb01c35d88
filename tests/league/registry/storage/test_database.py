"""An SQLite file that is moved, restored or replaced while it is in use, the timeouts of PostgreSQL, and records."""

import shutil
from contextlib import nullcontext
from dataclasses import FrozenInstanceError, fields, replace
from datetime import UTC, datetime
from inspect import getmembers, ismethod, signature
from pathlib import Path

import psycopg
import pytest
from sqlalchemy import event, inspect, text
from sqlalchemy.orm.exc import DetachedInstanceError

from league.errors import ConfigError, StorageError
from league.registry.registry import Registry
from league.registry.storage.database import Database
from league.registry.storage.rows import HEARTBEAT_TIMEOUT, KeyRow, Record, RunRow, VersionRow
from league.settings import Storage
from tests.support.leagues.registries import LEAGUE, publish, registered
from tests.support.mounts import fill, read_only, small_disk


def slugs(registry: Registry) -> list[str]:
    return list(registry.leagues.names())


def test_a_new_database_is_readable_by_its_owner_only(registry: Registry) -> None:
    registered(registry)
    home = registry.storage.home
    readable = {path.name for path in (home, *home.glob("league.db*")) if path.stat().st_mode & 0o077}
    assert readable <= {"league.db.lock"}, "the lock file is empty"


def test_a_moved_file_is_reported_and_found_again(registry: Registry, tmp_path: Path) -> None:
    path = tmp_path / "home" / "league.db"
    before = slugs(registry)
    for _ in range(2):
        path.rename(tmp_path / "elsewhere")
        for _ in range(3):
            with pytest.raises(StorageError, match=r"league\.db does not exist"):
                registry.leagues.names()
            with pytest.raises(StorageError, match=r"league\.db does not exist"):
                registry.publisher.sweep(before[0])
        assert not path.exists(), "a new file was created"
        (tmp_path / "elsewhere").rename(path)
        assert slugs(registry) == before


def test_a_replaced_file_is_used_from_then_on(registry: Registry, tmp_path: Path) -> None:
    path = tmp_path / "home" / "league.db"
    assert slugs(registry)
    Registry.open(Storage.at(tmp_path / "other")).close()
    for part in path.parent.glob("league.db*"):  # includes the write-ahead log
        part.unlink()
    shutil.move(tmp_path / "other" / "league.db", path)
    assert slugs(registry) == []
    registered(registry)
    assert slugs(Registry.open(registry.storage)) == slugs(registry) != []


def test_a_reader_creates_no_database(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match=r"league\.db does not exist"):
        Registry.open(Storage.at(tmp_path / "home"), create=False)
    assert not (tmp_path / "home").exists()


def test_a_database_that_cannot_be_written_is_read(registry: Registry) -> None:
    """Also with a write-ahead log: an open connection of another user."""
    registered(registry)
    home = registry.storage.home
    for is_open in (True, False):
        assert (home / "league.db-wal").exists() == is_open
        with read_only(home):
            reader = Registry.open(registry.storage)
            assert slugs(reader) == [LEAGUE]
            with pytest.raises(StorageError, match="attempt to write a readonly database"):
                reader.leagues.archive(LEAGUE)
            reader.close()
        registry.close()


def test_a_link_to_a_disk_that_is_not_mounted_is_called_so(tmp_path: Path) -> None:
    (tmp_path / "home").symlink_to("/missing/disk")
    (tmp_path / "file").symlink_to("/missing/disk/league.db")
    storage = Storage.at(tmp_path / "home")
    file = replace(storage, database_url=f"sqlite:///{tmp_path}/file")
    for broken, message in (
        (storage, "home cannot be used: it is a link to /missing/disk, which does not exist"),
        (Storage.at(tmp_path / "home" / "below"), "home cannot be used: it is a link to /missing/disk, which does not"),
        (file, "file cannot be used: it is a link to /missing/disk/league.db, which does not exist"),
    ):
        with pytest.raises(StorageError, match=message):
            Registry.open(broken)


def settings_of(url: str) -> tuple[dict[str, str], str, str]:
    """The parameters of the connection, and the timeouts of the session."""
    database = Database(url)
    with database.read() as session:
        driver = session.connection().connection.driver_connection
        assert isinstance(driver, psycopg.Connection)
        timeouts = [session.scalars(text(f"SHOW {name}")).one() for name in ("statement_timeout", "lock_timeout")]
        parameters = driver.info.get_parameters()
    database.close()
    return parameters, *timeouts


def test_a_transaction_does_not_wait_long_for_a_lock(postgresql_storage: Storage) -> None:
    database = Database(f"{postgresql_storage.database_url}%20-c%20lock_timeout%3D50ms")
    lock = text("LOCK TABLE leagues IN EXCLUSIVE MODE")
    with database.write() as first:
        first.execute(lock)
        with pytest.raises(StorageError, match="lock timeout"), database.write() as second:
            second.execute(lock)
    database.close()


@pytest.mark.parametrize(("raised", "records"), [(SystemExit(15), 0), (KeyboardInterrupt(), 0), (ValueError(), 1)])
def test_a_signal_while_a_connection_is_returned_is_not_logged(
    registry: Registry, caplog: pytest.LogCaptureFixture, raised: BaseException, records: int
) -> None:
    def reset(*_: object) -> None:
        event.remove(registry.database.engine, "reset", reset)
        raise raised

    event.listen(registry.database.engine, "reset", reset)
    with nullcontext() if records else pytest.raises(type(raised)):
        registry.leagues.names()
    assert len(caplog.records) == records


def test_a_full_disk_is_called_so(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk") as disk:
        storage = Storage(disk, f"sqlite:///{disk}/league.db", disk / "artifacts")
        registry = Registry.open(storage)
        registry.keys.create("first", ["act"])
        fill(disk)
        with pytest.raises(StorageError, match=r"the disk of .*/disk is full: 0 bytes are free"):
            registry.keys.create("a-second", ["act"])
        registry.close()
        for path in disk.glob("league.db-*"):
            path.unlink()
        fill(disk)
        with pytest.raises(StorageError, match=r"the disk of .*/disk is full"):
            Registry.open(storage)


def test_connections_to_postgresql_have_timeouts_that_the_url_can_change(postgresql_storage: Storage) -> None:
    server = postgresql_storage.database_url
    parameters, statement, lock = settings_of(server)
    assert (parameters["connect_timeout"], parameters["tcp_user_timeout"]) == ("3", "5000")
    assert (statement, lock) == ("30s", "10s")
    parameters, statement, lock = settings_of(f"{server}%20-c%20statement_timeout%3D0&connect_timeout=9")
    assert (parameters["connect_timeout"], parameters["tcp_user_timeout"]) == ("9", "5000")
    assert (statement, lock) == ("0", "10s")


def test_an_unsupported_database_is_reported_in_one_line(tmp_path: Path) -> None:
    for url, message in (
        ("mysql://host/league", "names 'mysql': expected sqlite or postgresql"),
        ("no url at all: secret", "LEAGUE_DATABASE_URL is not a URL: expected sqlite"),
        ("sqlite://", "does not name a file"),
        ("sqlite:///:memory:", "does not name a file"),
    ):
        with pytest.raises(ConfigError, match=message):
            Database(url)
    with pytest.raises(StorageError) as caught:
        Database(f"postgresql://somebody:secret@/league?host={tmp_path}")
    assert "\n" not in str(caught.value)
    assert "secret" not in str(caught.value)
    (tmp_path / "league.db").write_text("these are not the bytes of a database, however long they go on " * 100)
    with pytest.raises(StorageError, match=r"league\.db cannot be used: file is not a database"):
        Registry.open(Storage.at(tmp_path))


@pytest.fixture
def records(registry: Registry) -> dict[type[Record], Record]:
    """A record that was read, and records that were created."""
    publish(registry, "run/1000")
    event = registry.aliases.set(LEAGUE, "champion", 1, expected=None, actor="ada", reason="test")
    run = registry.runs.begin(LEAGUE, "run", algorithm="ppo", settings={}, seed=1, target=9)
    key, _ = registry.keys.create("ci", ["read"])
    rows = [registry.leagues.get(LEAGUE), event, run, key, registry.nightly_runs.open(LEAGUE, [1], 0.1)]
    return {type(record): record for record in rows}


def test_records_are_immutable_after_their_transaction(records: dict[type[Record], Record], registry: Registry) -> None:
    for record in records.values():
        assert inspect(record).detached
        for name in (field.name for field in fields(record)):
            with pytest.raises(FrozenInstanceError, match=f"{name} of {type(record).__name__} cannot be set"):
                setattr(record, name, None)
    (key,) = registry.keys.all()
    assert key == records[KeyRow]
    assert key != replace(key, expires_at=datetime.now(UTC))
    assert registry.runs.get(LEAGUE, "run") == records[RunRow]


def test_callers_see_no_session(registry: Registry) -> None:
    assert str(signature(registry.versions.get)) == f"(league: str, number: int) -> {VersionRow.__module__}.VersionRow"
    for repository in vars(registry).values():
        for name, method in getmembers(repository, ismethod):
            assert "session" not in signature(method).parameters, name


def test_the_record_of_a_run_is_read_only_where_it_is_needed(registry: Registry) -> None:
    registry.runs.begin(LEAGUE, "run", algorithm="ppo", settings={}, seed=1, target=9, record={"pins": {}})
    registry.runs.begin(LEAGUE, "other", algorithm="ppo", settings={}, seed=1, target=9)
    with pytest.raises(DetachedInstanceError):
        _ = registry.runs.get(LEAGUE, "run").record
    assert [(run.id, run.record) for run in registry.runs.stored(LEAGUE)] == [("run", {"pins": {}})]


def test_a_run_is_silent_without_heartbeats(records: dict[type[Record], Record]) -> None:
    run = records[RunRow]
    assert isinstance(run, RunRow)
    silent_since = datetime.now(UTC) - 2 * HEARTBEAT_TIMEOUT
    assert run.state == "running"
    assert replace(run, heartbeat_at=silent_since).state == "silent"
    assert replace(run, heartbeat_at=silent_since, reported_state="ended").state == "ended"
