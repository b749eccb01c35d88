"""Files of checkpoint versions in an object store: S3, Google Cloud Storage or Azure.

<url>/<league>/<number>/manifest.json, <policy>.onnx, training/…

Files are uploaded first and the manifest last. A version is visible once its row in the registry is ready. Files are
verified by the digests in that row, so other objects in the store have no influence. Those that are read are cached on
the local disk by their SHA-256. Several processes may share a cache.
"""

import hashlib
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import timedelta
from pathlib import Path, PurePosixPath
from typing import Any

from league.errors import ConfigError, StorageError, one_line
from league.files import check_digest, digests_of, disk_errors, files_in
from league.registry.storage.artifacts import ArtifactStore, files_missing, label
from league.registry.storage.manifest import MANIFEST, TRAINING, Manifest

CACHE_LIMIT = 4 * 10**9
"""Bytes. The files that were not used for the longest time are removed beyond it."""


class DigestCache:
    """A directory of files that are named by their digest. limit: size of all files, in bytes."""

    def __init__(self, directory: Path, limit: int = CACHE_LIMIT) -> None:
        self._directory = directory
        self._limit = limit

    def read(self, sha256: str, fetch: Callable[[], bytes | None]) -> bytes | None:
        """Return the content with this digest, from the cache or else from `fetch`.

        A cached file that was damaged is fetched again. Content of `fetch` with another digest is returned, but not
        cached. None: `fetch` found nothing.
        """
        path = self._directory / sha256
        with suppress(OSError):
            content = path.read_bytes()
            if hashlib.sha256(content).hexdigest() == sha256:
                os.utime(path)
                return content
        fetched = fetch()
        if fetched is not None and hashlib.sha256(fetched).hexdigest() == sha256:
            self._write(path, fetched)
        return fetched

    def _write(self, path: Path, content: bytes) -> None:
        with disk_errors(path):
            self._directory.mkdir(parents=True, exist_ok=True)
            # Other processes may write the same file.
            descriptor, draft = tempfile.mkstemp(dir=self._directory, prefix=".part-")
            try:
                with os.fdopen(descriptor, "wb") as file:
                    file.write(content)
                Path(draft).replace(path)
            except BaseException:
                Path(draft).unlink(missing_ok=True)
                raise
        self._evict(path)

    def _evict(self, newest: Path) -> None:
        entries = []
        for path in self._directory.iterdir():
            with suppress(FileNotFoundError):
                state = path.stat()
                entries.append((state.st_mtime_ns, state.st_size, path))
        excess = sum(size for _, size, _ in entries) - self._limit
        for _, size, path in sorted(entries):
            if excess <= 0:
                return
            if path != newest:
                with suppress(OSError):
                    path.unlink()
                excess -= size


REMOVED = "training.removed"
"""Object of a version whose training state is being removed, or was removed."""
CONNECT_TIMEOUT = timedelta(seconds=3)
REQUEST_TIMEOUT = timedelta(seconds=30)
RETRY_TIMEOUT = timedelta(seconds=10)
EXPIRED = ("ExpiredToken", "RequestExpired", "TokenRefreshRequired")
"""Error codes of S3, which obstore does not distinguish."""
REFUSED = ("401 Unauthorized", "403 Forbidden")
"""Statuses that obstore does not distinguish when objects are listed."""
PROBE = ".league-probe"
"""Object that `check_writable` writes and deletes."""


class ObjectArtifactStore(ArtifactStore):
    """Artefacts at the URL of an object store. local: a directory for uploads in progress and for cached files."""

    def __init__(self, url: str, local: Path) -> None:
        super().__init__(local)
        self.url = url
        self._store = _connect(url)
        self._cache = DigestCache(local / "cache")

    def check_writable(self) -> None:
        """Write and delete an object. Raises StorageError if the store refuses this or is unreachable."""
        with self._errors():
            self._store.put(PROBE, b"")
            self._store.delete(PROBE)

    def last(self, league: str) -> int:
        """Return the highest number that the store has objects of; 0 if there is none."""
        with self._errors():
            prefixes = self._store.list_with_delimiter(f"{league}/")["common_prefixes"]
        names = (PurePosixPath(prefix).name for prefix in prefixes)
        return max(super().last(league), max((int(name) for name in names if name.isdecimal()), default=0))

    def commit(self, manifest: Manifest) -> str:
        """Upload the staged files, the manifest last; returns its text."""
        staging, key = self._staging(manifest.league, manifest.version), self._key(manifest.league, manifest.version)
        with disk_errors(staging), self._errors():
            names = [name for name in files_in(staging) if name != MANIFEST]
            text = manifest.model_copy(update={"files": digests_of(staging, names)}).to_json()
            for name in names:
                self._store.put(f"{key}/{name}", staging / name)
            self._store.put(f"{key}/{MANIFEST}", text.encode())
            shutil.rmtree(staging)
        return text

    def discard(self, league: str, number: int) -> None:
        """Remove all files of a version. Must not be called for a ready version."""
        super().discard(league, number)
        self._delete(f"{self._key(league, number)}/")

    def remove_training(self, league: str, number: int) -> None:
        """Remove the training state of a version, completely or not at all for those who read it."""
        key = self._key(league, number)
        with self._errors():
            self._store.put(f"{key}/{REMOVED}", b"")
        self._delete(f"{key}/{TRAINING}/")

    def size(self, league: str, number: int) -> int:
        """Return the size of all files of a version, in bytes."""
        return sum(size for _, size in self._objects(f"{self._key(league, number)}/"))

    def training_size(self, league: str, number: int) -> int:
        """Return the size of a version's training state, in bytes, including a removal that was interrupted."""
        return sum(size for _, size in self._objects(f"{self._key(league, number)}/{TRAINING}/"))

    def is_purged(self, league: str, number: int) -> bool:  # noqa: ARG002
        """Return False: only the registry records which versions were removed."""
        return False

    def check_exists(self, league: str, number: int) -> None:
        """Raise FilesMissing if the store has no object of a version, although the registry has the version."""
        if not self._objects(f"{self._key(league, number)}/"):
            raise files_missing(league, number, f"{self.url}/{self._key(league, number)}")

    def has_folder(self, league: str, number: int, folder: str) -> bool:
        """Return whether a version has files in a folder."""
        key = self._key(league, number)
        names = [name for name, _ in self._objects(f"{key}/{folder}")]
        return f"{key}/{REMOVED}" not in names and any(name.startswith(f"{key}/{folder}/") for name in names)

    def verify_names(self, league: str, number: int, sha256: str) -> Manifest:
        """Return the manifest of a version. A missing file is reported when it is read. Raises ArtifactCorrupt."""
        return self.manifest(league, number, sha256)

    def copy(self, manifest: Manifest, folder: str, target: Path) -> None:
        """Stream the files of a folder to the new directory `target`, each verified. Raises ArtifactCorrupt."""
        with disk_errors(target):
            target.mkdir(mode=0o700)
        for name in manifest.files:
            if name.startswith(f"{folder}/"):
                self._download(manifest, name, target / PurePosixPath(name).relative_to(folder))

    def _content(self, league: str, number: int, name: str, digest: str) -> bytes | None:
        return self._cache.read(digest, lambda: self._get(f"{self._key(league, number)}/{name}"))

    def _get(self, key: str) -> bytes | None:
        with self._errors():
            response = self._find(key)
            return None if response is None else bytes(response.bytes())

    def _find(self, key: str) -> Any:
        """The response with an object; None if there is none in the bucket."""
        try:
            return self._store.get(key)
        except FileNotFoundError as error:
            if _is_missing_bucket(error):
                raise
            return None

    def _download(self, manifest: Manifest, name: str, target: Path) -> None:
        """Stream a file to `target`."""
        hashed = hashlib.sha256()
        with disk_errors(target), self._errors():
            response = self._find(f"{self._key(manifest.league, manifest.version)}/{name}")
            if response is not None:
                target.parent.mkdir(parents=True, exist_ok=True)
                with target.open("wb") as file:
                    for chunk in response.stream():
                        hashed.update(chunk)
                        file.write(chunk)
        digest = None if response is None else hashed.hexdigest()
        check_digest(label(manifest.league, manifest.version, name), manifest.files[name], digest)

    def _objects(self, prefix: str) -> list[tuple[str, int]]:
        """Return key and size of the objects whose key starts with `prefix`."""
        directory = prefix.rpartition("/")[0]
        with self._errors():
            objects = [(meta["path"], meta["size"]) for page in self._store.list(directory) for meta in page]
        return [(key, size) for key, size in objects if key.startswith(prefix)]

    def _delete(self, prefix: str) -> None:
        keys = [key for key, _ in self._objects(prefix)]
        with self._errors():
            for key in keys:
                self._store.delete(key)

    @staticmethod
    def _key(league: str, number: int) -> str:
        return f"{league}/{number}"

    @contextmanager
    def _errors(self) -> Iterator[None]:
        """Translate the store's errors into a StorageError that names the store and the remedy."""
        from obstore.exceptions import BaseError, PermissionDeniedError, UnauthenticatedError

        try:
            yield
        except (FileNotFoundError, BaseError) as error:
            is_refused = isinstance(error, (PermissionDeniedError, UnauthenticatedError))
            if _is_missing_bucket(error):
                raise StorageError(
                    f"{self.url}: the bucket does not exist: create it, or correct LEAGUE_ARTIFACTS"
                ) from error
            if isinstance(error, FileNotFoundError):
                raise
            if any(code in str(error) for code in EXPIRED):
                raise StorageError(f"{self.url}: the credentials have expired: renew them ({_cause(error)})") from error
            if is_refused or any(status in str(error) for status in REFUSED):
                raise StorageError(
                    f"{self.url} refuses the credentials: renew them, or grant them access ({_cause(error)})"
                ) from error
            raise StorageError(f"{self.url} cannot be used: check network and credentials ({_cause(error)})") from error


def _connect(url: str) -> Any:
    try:
        from obstore.exceptions import BaseError
        from obstore.store import from_url
    except ImportError as error:
        raise ConfigError(
            f"LEAGUE_ARTIFACTS={url} requires obstore: pip install 'policy-league[object-store]'"
        ) from error
    try:
        return from_url(
            url,
            # Applies only to an endpoint that the user sets with this scheme. The default ones have https.
            client_options={"allow_http": True, "connect_timeout": CONNECT_TIMEOUT, "timeout": REQUEST_TIMEOUT},
            retry_config={"max_retries": 2, "retry_timeout": RETRY_TIMEOUT},
        )
    except (BaseError, ValueError) as error:
        raise ConfigError(f"LEAGUE_ARTIFACTS={url} is invalid: {_cause(error)}") from error


def _is_missing_bucket(error: Exception) -> bool:
    return any(code in str(error) for code in ("NoSuchBucket", "ContainerNotFound", "bucket does not exist"))


def _cause(error: Exception) -> str:
    """The first line of an error of obstore; the others repeat it for programmers."""
    return one_line(error, first_line=True)[:300]
