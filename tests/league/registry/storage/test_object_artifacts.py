"""An object store: its cache, its errors, and publishers that are killed."""

import hashlib
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from league.errors import ConfigError, FilesMissing, LeagueError, StorageError
from league.registry.registry import Registry
from league.registry.storage import object_artifacts
from league.registry.storage.object_artifacts import DigestCache, ObjectArtifactStore
from league.settings import Storage
from tests.support.leagues.registries import GRAPH, LEAGUE, publish, registered
from tests.support.servers import object_store


@pytest.fixture
def remote(bucket: str, tmp_path: Path) -> Registry:
    home = Storage.at(tmp_path / "home")
    return registered(Registry.open(Storage(home.home, home.database_url, bucket)))


def test_a_cached_version_is_read_without_the_store(remote: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    version = publish(remote, "run/1")
    remote.artifacts.read(remote.artifacts.verify_names(LEAGUE, 1, version.sha256), "shared.onnx")
    monkeypatch.setattr(remote.artifacts, "_get", lambda key: pytest.fail(f"{key} was fetched"))
    assert not remote.artifacts.is_purged(LEAGUE, 1)
    manifest = remote.artifacts.verify_names(LEAGUE, 1, version.sha256)
    assert remote.artifacts.read(manifest, "shared.onnx") == GRAPH


def test_a_version_without_objects_is_reported(bucket: str, remote: Registry) -> None:
    publish(remote, "run/1")
    remote.artifacts.check_exists(LEAGUE, 1)
    remote.artifacts.discard(LEAGUE, 1)
    with pytest.raises(FilesMissing, match=f"{bucket}/{LEAGUE}/1 does not exist; "):
        remote.artifacts.check_exists(LEAGUE, 1)


def test_without_obstore_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "obstore.store", None)
    with pytest.raises(ConfigError, match=r"pip install 'policy-league\[object-store\]'"):
        ObjectArtifactStore("s3://bucket/prefix", tmp_path)


KILLED = """
import os, signal, sys
from pathlib import Path
from league.registry.registry import Registry
from league.settings import Storage
from tests.support.leagues.registries import publish

home, database, url, point = sys.argv[1:]
registry = Registry.open(Storage(Path(home), database, url))
store, count = registry.artifacts._store, 0

class Killed:
    def __getattr__(self, name):
        return getattr(store, name)
    def put(self, *arguments):
        global count
        if count == int(point):
            os.kill(os.getpid(), signal.SIGKILL)
        count += 1
        return store.put(*arguments)

registry.artifacts._store = Killed()
publish(registry, "run/1")
"""


@pytest.mark.parametrize("point", [2, *(pytest.param(count, marks=pytest.mark.slow) for count in (0, 1, 3))])
def test_a_killed_publisher_leaves_no_version(remote: Registry, bucket: str, point: int) -> None:
    """point: number of objects that were uploaded; the fourth is the manifest."""
    arguments = [str(remote.storage.home), remote.storage.database_url, bucket, str(point)]
    killed = subprocess.run([sys.executable, "-c", KILLED, *arguments], capture_output=True, check=False)
    assert killed.returncode == -signal.SIGKILL, killed.stderr.decode()
    assert len(object_store.keys(bucket)) == point
    assert remote.versions.all(LEAGUE) == []
    assert publish(remote, "run/1").number == 2
    assert {key.split("/")[1] for key in object_store.keys(bucket)} == {"2"}


def test_each_kind_of_store_is_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AZURE_STORAGE_ACCOUNT_NAME", raising=False)
    with pytest.raises(ConfigError, match=r"LEAGUE_ARTIFACTS=az://container is invalid: .*Account must be specified"):
        object_artifacts._connect("az://container")
    monkeypatch.setenv("AZURE_STORAGE_ACCOUNT_NAME", "account")
    for scheme, store in (("s3", "S3Store"), ("gs", "GCSStore"), ("az", "AzureStore")):
        opened = object_artifacts._connect(f"{scheme}://bucket/prefix")
        assert (type(opened).__name__, opened.prefix) == (store, "prefix")


def test_a_file_is_fetched_once_unless_it_is_damaged(tmp_path: Path) -> None:
    cache, digest, fetched = DigestCache(tmp_path), _digest(b"graph"), iter([b"other", b"graph", b"graph"])
    assert cache.read(digest, lambda: next(fetched)) == b"other"
    assert list(tmp_path.iterdir()) == [], "content with another digest is not cached"
    assert [cache.read(digest, lambda: next(fetched)) for _ in range(2)] == [b"graph", b"graph"]
    (tmp_path / digest).write_bytes(b"damaged")
    assert cache.read(digest, lambda: next(fetched)) == b"graph"
    assert (tmp_path / digest).read_bytes() == b"graph"


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def test_the_oldest_files_are_removed_beyond_the_limit(tmp_path: Path) -> None:
    cache, contents = DigestCache(tmp_path, limit=20), [bytes([i]) * 10 for i in range(3)]
    for i, content in enumerate(contents[:2]):
        cache.read(_digest(content), lambda content=content: content)  # type: ignore[misc]
        os.utime(tmp_path / _digest(content), (i, i))
    cache.read(_digest(contents[2]), lambda: contents[2])
    assert {path.name for path in tmp_path.iterdir()} == {_digest(content) for content in contents[1:]}


def test_a_store_that_cannot_be_used_is_reported(
    bucket: str, tmp_path: Path, s3_endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = ObjectArtifactStore(bucket, tmp_path)
    store.check_writable()
    assert object_store.keys(bucket) == [], "it stays empty"
    missing = ObjectArtifactStore("s3://no-such-bucket/prefix", tmp_path)
    _assert_reports(missing, "the bucket does not exist: create it")
    with object_store.refusing_credentials(s3_endpoint):
        _assert_reports(store, "refuses the credentials: renew them")
    for name, value in object_store.variables("http://127.0.0.1:9").items():
        monkeypatch.setenv(name, value)
    _assert_reports(ObjectArtifactStore("s3://bucket/prefix", tmp_path), "cannot be used: check network", calls=1)


def _assert_reports(store: ObjectArtifactStore, message: str, calls: int = 3) -> None:
    for call in (lambda: store._get("a/1/b"), lambda: store.last(LEAGUE), store.check_writable)[:calls]:
        with pytest.raises(StorageError, match=message) as caught:
            call()
        assert "\n" not in str(caught.value)
        assert "s3://" in str(caught.value)


def test_expired_credentials_are_reported(bucket: str, tmp_path: Path) -> None:
    from obstore.exceptions import GenericError, PermissionDeniedError

    store = ObjectArtifactStore(bucket, tmp_path)
    errors = [*((GenericError(code), "expired: renew") for code in object_artifacts.EXPIRED)]
    for error, message in (*errors, (PermissionDeniedError("403"), "refuses the cred")):
        with pytest.raises(LeagueError, match=message), store._errors():
            raise error
