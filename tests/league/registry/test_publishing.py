"""A version is published completely or not at all."""

import errno
import hashlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from sqlalchemy import select, update

from league.errors import EnvironmentMismatch, InterfaceChanged, StorageError, UnknownVersion
from league.registry import publishing
from league.registry.processes import this_process
from league.registry.publishing import is_dead
from league.registry.registry import Registry
from league.registry.storage.manifest import Manifest
from league.registry.storage.tables import VersionTable
from league.settings import Storage
from tests.support.leagues.registries import GRAPH, LEAGUE, builder, leftovers, manifest, publish, verified


def rows(registry: Registry) -> list[int]:
    """Numbers of all rows, including those that are not ready."""
    with registry.database.read() as session:
        return list(session.scalars(select(VersionTable.number).order_by(VersionTable.number)))


def test_a_version_has_number_manifest_and_digest(registry: Registry) -> None:
    version = publish(registry, "run/1")
    directory = registry.artifacts.path(LEAGUE, 1)
    assert (version.ref, version.parent, version.steps, version.aliases) == ("tictactoe@1", None, 1000, ())
    assert version.sha256 == hashlib.sha256((directory / "manifest.json").read_bytes()).hexdigest()
    assert version.manifest == Manifest.from_json((directory / "manifest.json").read_bytes(), "manifest.json")
    assert version.manifest.files == {
        name: hashlib.sha256((directory / name).read_bytes()).hexdigest()
        for name in ("shared.onnx", "training/state.bin", "training/learner/weights.bin")
    }
    assert (directory / "shared.onnx").read_bytes() == GRAPH
    assert directory == registry.storage.artifacts / LEAGUE / "1"


def test_a_source_is_published_once(registry: Registry) -> None:
    first = publish(registry, "run/1")

    def build(_: Path, __: int) -> Manifest:
        raise AssertionError("built again")

    assert registry.publisher.publish(LEAGUE, build, source="run/1") == first
    assert rows(registry) == [1]


def test_of_concurrent_publishers_of_a_source_the_first_wins(registry: Registry) -> None:
    def build(directory: Path, number: int) -> Manifest:
        publish(registry, "run/1")
        return builder()(directory, number)

    version = registry.publisher.publish(LEAGUE, build, source="run/1")
    assert version.number == 2
    assert rows(registry) == [2]
    assert leftovers(registry) == []


def test_an_expired_reservation_cannot_become_ready(registry: Registry) -> None:
    def build(directory: Path, number: int) -> Manifest:
        with registry.database.write() as session:
            session.execute(update(VersionTable).values(reserved_at=datetime.now(UTC) - timedelta(days=2)))
        publish(registry, "run/2")
        directory.mkdir()
        return builder()(directory, number)

    with pytest.raises(StorageError, match="took too long"):
        registry.publisher.publish(LEAGUE, build, source="run/1")
    assert [version.number for version in registry.versions.all(LEAGUE)] == [2]


CRASH = """
import os, signal, sys
from pathlib import Path
from league.registry import publishing, registry
from league.registry.storage.artifacts import ArtifactStore
from league.settings import Storage
from tests.support.leagues.registries import LEAGUE, builder

def die(*_, **__):
    os.kill(os.getpid(), signal.SIGKILL)

def build(directory, number):
    manifest = builder()(directory, number)
    if point == "while building":
        die()
    if point == "while clearing away":
        raise RuntimeError
    return manifest

point, home, url = sys.argv[1:]
match point:
    case "before the rename":
        Path.rename = die
    case "after the rename":
        publishing.finish = die
    case "while clearing away":
        ArtifactStore.discard = die
opened = registry.Registry.open(Storage(Path(home), url, Path(home) / "artifacts"))
opened.publisher.publish(LEAGUE, build, source="run/1")
"""


POINTS = ["while building", "before the rename", "after the rename", "while clearing away"]


@pytest.mark.parametrize(
    "point",
    [point if point == "before the rename" else pytest.param(point, marks=pytest.mark.slow) for point in POINTS],
)
def test_a_killed_publisher_leaves_no_version(registry: Registry, storage: Storage, point: str) -> None:
    arguments = [sys.executable, "-c", CRASH, point, str(storage.home), storage.database_url]
    killed = subprocess.run(arguments, capture_output=True, check=False)
    assert killed.returncode == -signal.SIGKILL, killed.stderr.decode()
    assert registry.versions.all(LEAGUE) == []
    assert leftovers(registry) != [], "the publisher was killed too late"
    assert publish(registry, "run/1").number == 2
    assert rows(registry) == [2]
    assert leftovers(registry) == []


def test_a_commit_with_a_lost_response_keeps_the_version(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    database, write = registry.database, registry.database.write
    finish = publishing.finish

    def commit_then_disconnect(session: object, *arguments: object) -> int:
        with write() as other:
            session.rollback()  # type: ignore[attr-defined]
            finish(other, *arguments)  # type: ignore[arg-type]
        raise StorageError("the connection was lost")

    monkeypatch.setattr(publishing, "finish", commit_then_disconnect)
    with pytest.raises(StorageError, match="connection was lost"):
        publish(registry, "run/1")
    monkeypatch.undo()
    assert registry.database is database
    assert verified(registry, 1).version == 1
    assert publish(registry, "run/1").number == 1


READ_ONLY = """
import os, sys
from sqlalchemy import text
from league.errors import LeagueError
from league.registry.registry import Registry
from league.settings import Storage

# The first home is writable: what is imported on demand may be unreadable for another account.
for number, home in enumerate(sys.argv[1:]):
    if number == 1 and os.geteuid() == 0:
        os.setuid(65534)
    try:
        with Registry.open(Storage.at(home)).database.write() as session:
            session.execute(text("DELETE FROM leagues"))
        print("written")
    except LeagueError as error:
        print(f"{type(error).__name__}: {error}")
"""


@pytest.fixture
def readable() -> Iterator[Path]:
    """A directory that other accounts can read."""
    with TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        yield Path(name)
        for path in Path(name).iterdir():
            path.chmod(0o755)


def test_a_read_only_home_is_reported_in_one_line(readable: Path) -> None:
    writable, fresh, used = (readable / name for name in ("writable", "fresh", "used"))
    fresh.mkdir()
    Registry.open(Storage.at(used)).close()
    for path in used.rglob("*"):
        path.chmod(0o444)
    for home in (fresh, used):
        home.chmod(0o555)
    command = [sys.executable, "-c", READ_ONLY, str(writable), str(fresh), str(used)]
    refusals = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    assert refusals[0] == "written"
    for home, refusal in zip((fresh, used), refusals[1:], strict=True):
        assert refusal.startswith("StorageError: ")
        assert str(home) in refusal


def test_a_manifest_must_be_consistent() -> None:
    document = json.loads(manifest(1).to_json())
    for change, message in (
        ({"environment_digest": "0"}, "environment_digest is not that of the environment"),
        ({"policies": {}}, "policies must be shared"),
    ):
        with pytest.raises(ValueError, match=message):
            Manifest.model_validate(document | change)
    document["policies"]["shared"]["action"]["n"] = 4
    with pytest.raises(ValueError, match="policy shared has other spaces than its agents"):
        Manifest.model_validate(document)


def test_versions_are_listed_newest_first(registry: Registry) -> None:
    for run in range(4):
        publish(registry, f"run/{run}")
    registry.aliases.set(LEAGUE, "champion", 3, expected=None, actor="ada", reason="test")
    page = registry.versions.newest(LEAGUE, limit=2)
    assert [(version.number, version.aliases) for version in page] == [(4, ()), (3, ("champion",))]
    assert [version.number for version in registry.versions.newest(LEAGUE, before=3, limit=5)] == [2, 1]


def test_unknown_parents_and_other_spaces_are_rejected(registry: Registry) -> None:
    with pytest.raises(UnknownVersion, match="has no version 7; none is published yet"):
        publish(registry, "run/1", parent=7)
    with pytest.raises(InterfaceChanged):
        registry.publisher.publish(LEAGUE, builder(squares=4), source="run/1")
    with pytest.raises(EnvironmentMismatch, match=r"tictactoe@9 .* expected tictactoe@\d"):
        registry.publisher.publish(LEAGUE, lambda _, __: manifest(9), source="run/1")
    assert rows(registry) == []
    assert leftovers(registry) == []


FULL, TOO_LARGE = (OSError(code, os.strerror(code), "shared.onnx") for code in (errno.ENOSPC, errno.EFBIG))


@pytest.mark.parametrize(
    ("error", "raised", "message"),
    [
        (RuntimeError("no parity"), RuntimeError, "no parity"),
        (KeyboardInterrupt("ended"), KeyboardInterrupt, "ended"),
        (ConnectionRefusedError(errno.ECONNREFUSED, "refused"), ConnectionRefusedError, "refused"),
        (FULL, StorageError, r"shared\.onnx cannot be used: No space left on device$"),
        (TOO_LARGE, StorageError, r"shared\.onnx cannot be used: File too large$"),
    ],
)
def test_a_failed_build_leaves_nothing(
    registry: Registry, error: BaseException, raised: type[BaseException], message: str
) -> None:
    def fail(directory: Path, _: int) -> Manifest:
        (directory / "shared.onnx").write_bytes(GRAPH)
        raise error

    with pytest.raises(raised, match=message):
        registry.publisher.publish(LEAGUE, fail, source="run/1")
    assert rows(registry) == []
    assert leftovers(registry) == []
    assert publish(registry, "run/1").number == 2, "numbers are not reused"


def test_a_live_publisher_is_not_disturbed(registry: Registry) -> None:
    def build(directory: Path, number: int) -> Manifest:
        publish(registry, "run/2")
        return builder()(directory, number)

    assert registry.publisher.publish(LEAGUE, build, source="run/1").number == 1
    assert publish(registry, "run/3", parent=2).parent == 2
    assert [version.number for version in registry.versions.all(LEAGUE)] == [1, 2, 3]


def test_publishers_that_are_gone_are_dead() -> None:
    machine, pid, start = this_process().split(":")
    moment, host, other = datetime.now(UTC), machine.partition("/")[0], int(start) - 1
    assert not is_dead(f"{machine}:{pid}:{start}", moment)
    assert is_dead(f"{machine}:{pid}:{other}", moment), "another process with this id"
    assert not is_dead(f"elsewhere:{pid}:{other}", moment), "processes of other hosts are unknown"
    assert not is_dead(f"{host}/another-start/1:{pid}:{other}", moment), "as are those of a machine with the same name"


def test_artifacts_survive_the_loss_of_the_database(registry: Registry, tmp_path: Path) -> None:
    publish(registry, "run/1")
    path = registry.storage.artifacts / LEAGUE / "1" / "manifest.json"
    stored = path.read_bytes()
    fresh = Registry.open(Storage(tmp_path, f"sqlite:///{tmp_path / 'new.db'}", registry.storage.artifacts))
    fresh.leagues.register(registry.leagues.get(LEAGUE).config, registry.leagues.get(LEAGUE).interface)
    assert publish(fresh, "run/2").number == 2
    assert path.read_bytes() == stored
    registry.artifacts.stage(LEAGUE, 7)
    assert publish(fresh, "run/3").number == 8, "an unfinished publication reserves its number"
    fresh.close()
