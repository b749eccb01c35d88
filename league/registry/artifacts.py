"""The files of checkpoint versions: whole or absent, and no byte used that the manifest does not vouch for.

<root>/<league>/<number>/manifest.json, <policy>.onnx, training/…
<root>/<league>/.publishing-<number>/           being written
"""

import hashlib
import os
import shutil
from contextlib import suppress
from pathlib import Path

from league.errors import ArtifactCorrupt
from league.registry.faults import disk_faults
from league.registry.manifest import MANIFEST, Manifest

STAGING = ".publishing-"


class ArtifactStore:
    """A directory of artefacts on a disk that all who publish, evaluate and serve can reach."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def path(self, league: str, number: int) -> Path:
        """Where a whole version lies."""
        return self.root / league / str(number)

    def last(self, league: str) -> int:
        """The highest number that a directory of the league has, ready or not; 0 if there is none.

        It exceeds what the database knows where that was lost: such versions are left alone.
        """
        with disk_faults(self.root), suppress(FileNotFoundError):
            names = [path.name.removeprefix(STAGING) for path in (self.root / league).iterdir()]
            return max((int(name) for name in names if name.isdecimal()), default=0)
        return 0

    def stage(self, league: str, number: int) -> Path:
        """Make the empty directory in which a version is put together, on the disk where it will stay."""
        staging = self._staging(league, number)
        with disk_faults(staging):
            staging.mkdir(parents=True)
        return staging

    def commit(self, manifest: Manifest) -> str:
        """Make what was staged a whole version; returns the text of its `manifest.json`.

        Everything reaches the disk before the rename that makes the version visible.
        """
        staging = self._staging(manifest.league, manifest.version)
        target = self.path(manifest.league, manifest.version)
        with disk_faults(target):
            digests = {name: _sha256(staging / name) for name in _files(staging) if name != MANIFEST}
            text = manifest.model_copy(update={"files": digests}).to_json()
            (staging / MANIFEST).write_text(text, encoding="utf-8")
            _flush(staging)
            staging.rename(target)
            _flush_directory(target.parent)
        return text

    def discard(self, league: str, number: int) -> None:
        """Remove whatever there is of a version. Never call it for one that is ready."""
        for directory in (self._staging(league, number), self.path(league, number)):
            with disk_faults(directory), suppress(FileNotFoundError):
                shutil.rmtree(directory)

    def is_purged(self, league: str, number: int) -> bool:
        """Whether the whole directory of a version is gone, while that of its league is there: it was removed.

        Where the league's is gone too, the disk may just not be mounted.
        """
        directory = self.path(league, number)
        with disk_faults(directory):
            return directory.parent.is_dir() and not directory.is_dir()

    def verify(self, league: str, number: int, sha256: str) -> Path:
        """The directory of a version whose every file is as it was published. Raises ArtifactCorrupt."""
        directory = self.path(league, number)
        with disk_faults(directory):
            manifest = self.manifest(league, number, sha256)
            present = set(_files(directory)) - {MANIFEST}
            for name in sorted(present - set(manifest.files)):
                raise ArtifactCorrupt(f"{directory / name} does not belong to {league}@{number}")
            for name, digest in manifest.files.items():
                path = directory / name
                # A pipe or a device, which a link may lead to, would be read for ever.
                _check(path, digest, _sha256(path) if name in present and path.is_file() else None)
        return directory

    def manifest(self, league: str, number: int, sha256: str) -> Manifest:
        """Read the manifest of a version. Raises ArtifactCorrupt unless its digest is `sha256`."""
        path = self.path(league, number) / MANIFEST
        return Manifest.from_json(_verified(path, sha256), source=str(path))

    def read(self, manifest: Manifest, name: str) -> bytes:
        """The bytes of one file of a version, verified as they are read. Raises ArtifactCorrupt."""
        if name not in manifest.files:
            raise ArtifactCorrupt(
                f"{manifest.league}@{manifest.version} has no file {name!r}, which its manifest names"
            )
        return _verified(self.path(manifest.league, manifest.version) / name, manifest.files[name])

    def _staging(self, league: str, number: int) -> Path:
        return self.root / league / f"{STAGING}{number}"


def _files(directory: Path) -> list[str]:
    """Relative paths of everything in `directory` but directories. A symbolic link counts as a file."""
    found = [path for path in directory.rglob("*") if path.is_symlink() or not path.is_dir()]
    return sorted(path.relative_to(directory).as_posix() for path in found)


def _verified(path: Path, digest: str) -> bytes:
    with disk_faults(path):
        content = path.read_bytes() if path.is_file() else None
    _check(path, digest, None if content is None else hashlib.sha256(content).hexdigest())
    assert content is not None
    return content


def _check(path: Path, expected: str, found: str | None) -> None:
    if found is None:
        raise ArtifactCorrupt(f"{path} is missing, or no regular file")
    if found != expected:
        raise ArtifactCorrupt(f"{path} was changed: its SHA-256 is {found[:12]}…, expected {expected[:12]}…")


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _flush(directory: Path) -> None:
    """Force a directory tree to the disk, files first."""
    for current, _, names in os.walk(directory, topdown=False):
        for name in names:
            with (Path(current) / name).open("rb") as file:
                os.fsync(file.fileno())
        _flush_directory(Path(current))


def _flush_directory(directory: Path) -> None:
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
