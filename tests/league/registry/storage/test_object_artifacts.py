"""An object store: its cache, its errors, and publishers that are killed."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from league.errors import ConfigError, FilesMissing, LeagueError, StorageError
from league.registry.registry import Registry
from league.registry.storage import object_artifacts
from league.registry.storage.object_artifacts import ObjectArtifactStore
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


def test_an_unreachable_store_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in object_store.variables("http://127.0.0.1:9").items():
        monkeypatch.setenv(name, value)
    _reports(ObjectArtifactStore("s3://bucket/prefix", tmp_path), "cannot be used: check network")


def test_a_missing_bucket_is_reported(bucket: str, tmp_path: Path) -> None:
    _reports(ObjectArtifactStore("s3://no-such-bucket/prefix", tmp_path), "the bucket does not exist: create it")


def test_a_reachable_store_is_writable_and_stays_empty(bucket: str, tmp_path: Path) -> None:
    ObjectArtifactStore(bucket, tmp_path).check_writable()
    assert object_store.keys(bucket) == []


def test_without_obstore_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "obstore.store", None)
    with pytest.raises(ConfigError, match=r"pip install 'policy-league\[object-store\]'"):
        ObjectArtifactStore("s3://bucket/prefix", tmp_path)


def _reports(store: ObjectArtifactStore, message: str) -> None:
    for call in (store.check_writable, lambda: store.last(LEAGUE), lambda: store._get("a/1/b")):
        with pytest.raises(StorageError, match=message) as caught:
            call()
        assert "\n" not in str(caught.value)
        assert "s3://" in str(caught.value)


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


@pytest.mark.parametrize("point", [2, *(pytest.param(each, marks=pytest.mark.slow) for each in (0, 1, 3))])
def test_a_killed_publisher_leaves_no_version(remote: Registry, bucket: str, point: int) -> None:
    """point: number of objects that were uploaded; the fourth is the manifest."""
    arguments = [str(remote.storage.home), remote.storage.database_url, bucket, str(point)]
    killed = subprocess.run([sys.executable, "-c", KILLED, *arguments], capture_output=True, check=False)
    assert killed.returncode == -signal.SIGKILL, killed.stderr.decode()
    assert len(object_store.keys(bucket)) == point
    assert remote.versions.all(LEAGUE) == []
    assert publish(remote, "run/1").number == 2
    assert {key.split("/")[1] for key in object_store.keys(bucket)} == {"2"}


def test_refused_credentials_are_reported(bucket: str, tmp_path: Path, s3_endpoint: str) -> None:
    with object_store.refusing_credentials(s3_endpoint):
        _reports(ObjectArtifactStore(bucket, tmp_path), "refuses the credentials: renew them")


@pytest.mark.parametrize("code", object_artifacts.EXPIRED)
def test_expired_credentials_are_reported(bucket: str, tmp_path: Path, code: str) -> None:
    from obstore.exceptions import GenericError, PermissionDeniedError

    store = ObjectArtifactStore(bucket, tmp_path)
    for error, message in ((GenericError(code), "expired: renew"), (PermissionDeniedError("403"), "refuses the cred")):
        with pytest.raises(LeagueError, match=message), store._errors():
            raise error


@pytest.mark.parametrize(
    ("url", "store"),
    [
        ("s3://bucket/prefix", "S3Store"),
        ("gs://bucket/prefix", "GCSStore"),
        ("az://container/prefix", "AzureStore"),
    ],
)
def test_each_kind_of_store_is_opened(url: str, store: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AZURE_STORAGE_ACCOUNT_NAME", "account")
    opened = object_artifacts._connect(url)
    assert (type(opened).__name__, opened.prefix) == (store, "prefix")


def test_azure_needs_an_account(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AZURE_STORAGE_ACCOUNT_NAME", raising=False)
    with pytest.raises(ConfigError, match=r"LEAGUE_ARTIFACTS=az://container is invalid: .*Account must be specified"):
        object_artifacts._connect("az://container")
