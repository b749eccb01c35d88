"""A version is published whole or not at all, whatever happens and whenever."""

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

from league.errors import (
    EnvironmentMismatch,
    InterfaceChanged,
    StorageError,
    UnknownLeague,
    UnknownVersion,
)
from league.registry import publishing
from league.registry.manifest import Manifest
from league.registry.registry import Registry
from league.registry.tables import Version
from league.settings import Storage
from tests.league.registry.examples import GRAPH, LEAGUE, builder, leftovers, manifest, publish


def rows(registry: Registry) -> list[int]:
    """Numbers of all rows, ready or not."""
    with registry.database.read() as session:
        return list(session.scalars(select(Version.number).order_by(Version.number)))


def test_a_version_is_numbered_described_and_digested(registry: Registry) -> None:
    version = publish(registry, "run/1")
    directory = registry.fetch(LEAGUE, 1)
    assert (version.ref, version.parent, version.steps, version.aliases) == ("tictactoe@1", None, 1000, ())
    assert version.sha256 == hashlib.sha256((directory / "manifest.json").read_bytes()).hexdigest()
    assert version.manifest == Manifest.from_json((directory / "manifest.json").read_bytes(), "manifest.json")
    assert version.manifest.files == {
        name: hashlib.sha256((directory / name).read_bytes()).hexdigest()
        for name in ("shared.onnx", "training/state.bin", "training/learner/weights.bin")
    }
    assert (directory / "shared.onnx").read_bytes() == GRAPH
    assert directory == registry.storage.artifacts / LEAGUE / "1"


def test_numbers_ascend_and_parents_are_kept(registry: Registry) -> None:
    publish(registry, "run/1")
    child = publish(registry, "run/2", parent=1)
    assert (child.number, child.parent) == (2, 1)
    assert [version.number for version in registry.versions(LEAGUE)] == [1, 2]


def test_the_same_source_is_published_once(registry: Registry) -> None:
    first = publish(registry, "run/1")

    def never(_: Path, __: int) -> Manifest:
        raise AssertionError("it is there already")

    assert registry.publish(LEAGUE, never, source="run/1") == first
    assert rows(registry) == [1]


def test_of_two_publishers_of_one_source_the_faster_wins(registry: Registry) -> None:
    def overtaken(directory: Path, number: int) -> Manifest:
        publish(registry, "run/1")
        return builder()(directory, number)

    version = registry.publish(LEAGUE, overtaken, source="run/1")
    assert version.number == 2
    assert rows(registry) == [2]
    assert leftovers(registry) == []


def test_unknown_leagues_and_parents_are_refused(registry: Registry) -> None:
    with pytest.raises(UnknownLeague):
        publish(registry, "run/1", league="chess")
    with pytest.raises(UnknownVersion, match="has no version 7; none is published yet"):
        publish(registry, "run/1", parent=7)
    assert rows(registry) == []


def test_another_interface_is_refused(registry: Registry) -> None:
    with pytest.raises(InterfaceChanged):
        registry.publish(LEAGUE, builder(squares=4), source="run/1")
    assert rows(registry) == []
    assert leftovers(registry) == []


def test_a_manifest_of_something_else_is_refused(registry: Registry) -> None:
    with pytest.raises(EnvironmentMismatch, match=r"tictactoe@9 .* expected tictactoe@1"):
        registry.publish(LEAGUE, lambda _, __: manifest(9), source="run/1")
    assert rows(registry) == []


@pytest.mark.parametrize("error", [RuntimeError("no parity"), KeyboardInterrupt()])
def test_a_failed_build_leaves_nothing(registry: Registry, error: BaseException) -> None:
    def fail(directory: Path, _: int) -> Manifest:
        (directory / "shared.onnx").write_bytes(GRAPH)
        raise error

    with pytest.raises(type(error)):
        registry.publish(LEAGUE, fail, source="run/1")
    assert rows(registry) == []
    assert leftovers(registry) == []
    assert publish(registry, "run/1").number == 2, "numbers are not used again"


def test_a_full_disk_is_one_line_and_leaves_nothing(registry: Registry) -> None:
    def full(directory: Path, _: int) -> Manifest:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(directory / "shared.onnx"))

    with pytest.raises(StorageError, match=r"shared\.onnx cannot be used: No space left on device$"):
        registry.publish(LEAGUE, full, source="run/1")
    assert rows(registry) == []
    assert leftovers(registry) == []


def test_faults_of_the_build_that_are_not_the_disk_s_pass(registry: Registry) -> None:
    def unreachable(_: Path, __: int) -> Manifest:
        raise ConnectionRefusedError(errno.ECONNREFUSED, "refused")

    with pytest.raises(ConnectionRefusedError):
        registry.publish(LEAGUE, unreachable, source="run/1")


def test_what_was_swept_meanwhile_cannot_become_ready(registry: Registry) -> None:
    def outlived(directory: Path, number: int) -> Manifest:
        with registry.database.write() as session:
            session.execute(update(Version).values(reserved_at=datetime.now(UTC) - timedelta(days=2)))
        publish(registry, "run/2")
        directory.mkdir()
        return builder()(directory, number)

    with pytest.raises(StorageError, match="cleared away"):
        registry.publish(LEAGUE, outlived, source="run/1")
    assert [version.number for version in registry.versions(LEAGUE)] == [2]


def test_a_publisher_that_lives_is_left_alone(registry: Registry) -> None:
    def interrupted(directory: Path, number: int) -> Manifest:
        publish(registry, "run/2")
        return builder()(directory, number)

    assert registry.publish(LEAGUE, interrupted, source="run/1").number == 1
    assert [version.number for version in registry.versions(LEAGUE)] == [1, 2]


def test_a_lost_database_costs_no_artefact(local: Registry, tmp_path: Path) -> None:
    publish(local, "run/1")
    kept = (local.storage.artifacts / LEAGUE / "1" / "manifest.json").read_bytes()
    storage = Storage(tmp_path, f"sqlite:///{tmp_path / 'new.db'}", local.storage.artifacts)
    fresh = Registry.open(storage)
    fresh.register(local.league(LEAGUE).config, local.league(LEAGUE).interface)
    assert publish(fresh, "run/2").number == 2
    assert (local.storage.artifacts / LEAGUE / "1" / "manifest.json").read_bytes() == kept
    fresh.close()


CRASH = """
import os, signal, sys
from pathlib import Path
from league.registry import publishing, registry
from league.registry.artifacts import ArtifactStore
from league.settings import Storage
from tests.league.registry.examples import LEAGUE, builder

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
opened.publish(LEAGUE, build, source="run/1")
"""
POINTS = ["while building", "before the rename", "after the rename", "while clearing away"]


@pytest.mark.parametrize("point", POINTS)
def test_a_killed_publisher_leaves_no_version(registry: Registry, storage: Storage, point: str) -> None:
    arguments = [sys.executable, "-c", CRASH, point, str(storage.home), storage.database_url]
    killed = subprocess.run(arguments, capture_output=True, check=False)
    assert killed.returncode == -signal.SIGKILL, killed.stderr.decode()
    assert registry.versions(LEAGUE) == []
    assert leftovers(registry) != [], "it was killed in the middle"
    assert publish(registry, "run/1").number == 2
    assert rows(registry) == [2]
    assert leftovers(registry) == []


def test_a_commit_whose_answer_got_lost_keeps_the_version(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    database, write = registry.database, registry.database.write
    finish = publishing.finish

    def committed_then_cut_off(session: object, *arguments: object) -> int:
        with write() as other:
            session.rollback()  # type: ignore[attr-defined]
            finish(other, *arguments)  # type: ignore[arg-type]
        raise StorageError("the connection was lost")

    monkeypatch.setattr(publishing, "finish", committed_then_cut_off)
    with pytest.raises(StorageError, match="connection was lost"):
        publish(registry, "run/1")
    monkeypatch.undo()
    assert registry.database is database
    assert registry.fetch(LEAGUE, 1).name == "1"
    assert publish(registry, "run/1").number == 1


LIMITED = """
import resource, signal, sys
from pathlib import Path
from league.errors import LeagueError
from league.registry.registry import Registry
from league.settings import Storage
from tests.league.registry.examples import LEAGUE, builder

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
registry = Registry.open(Storage.at(sys.argv[1]))
resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, 1_000_000))
try:
    registry.publish(LEAGUE, builder(graph=bytes(2_000_000)), source="run/1")
except LeagueError as error:
    print(f"{type(error).__name__}: {error}")
"""


def test_a_disk_that_takes_no_more_leaves_nothing(local: Registry) -> None:
    arguments = [sys.executable, "-c", LIMITED, str(local.storage.home)]
    limited = subprocess.run(arguments, capture_output=True, text=True, check=True)
    assert limited.stdout.startswith("StorageError: ")
    assert limited.stdout.count("\n") == 1
    assert local.versions(LEAGUE) == []
    assert leftovers(local) == []


READ_ONLY = """
import os, sys
from league.errors import LeagueError
from league.registry.registry import Registry
from league.settings import Storage
from tests.league.registry.examples import publish

if os.geteuid() == 0:
    os.setuid(65534)
try:
    publish(Registry.open(Storage.at(sys.argv[1])), "run/1")
except LeagueError as error:
    print(f"{type(error).__name__}: {error}")
"""


@pytest.fixture
def shut() -> Iterator[Path]:
    """A directory that other accounts can see and nobody but root can write, once it is shut."""
    with TemporaryDirectory() as name:
        yield Path(name)
        Path(name).chmod(0o755)


@pytest.mark.parametrize("fresh", [True, False])
def test_a_read_only_home_is_one_line(shut: Path, fresh: bool) -> None:
    if not fresh:
        Registry.open(Storage.at(shut)).close()
    for path in shut.rglob("*"):
        path.chmod(0o444)
    shut.chmod(0o555)
    arguments = [sys.executable, "-c", READ_ONLY, str(shut)]
    refused = subprocess.run(arguments, capture_output=True, text=True, check=True)
    assert refused.stdout.startswith("StorageError: ")
    assert str(shut) in refused.stdout
    assert refused.stdout.count("\n") == 1


def test_a_manifest_must_agree_with_itself() -> None:
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
    registry.set_alias(LEAGUE, "champion", 3, expected=None, actor="ada", reason="test")
    page = registry.newest_versions(LEAGUE, limit=2)
    assert [(version.number, version.aliases) for version in page] == [(4, ()), (3, ("champion",))]
    assert [version.number for version in registry.newest_versions(LEAGUE, before=3, limit=5)] == [2, 1]
    with pytest.raises(UnknownLeague):
        registry.newest_versions("chess")
