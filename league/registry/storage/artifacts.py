"""Files of checkpoint versions: published atomically and verified against the manifest.

<root>/<league>/<number>/manifest.json, <policy>.onnx, training/…
<root>/<league>/.publishing-<number>/           in progress
"""

import hashlib
import shutil
from contextlib import suppress
from pathlib import Path, PurePosixPath

from league.errors import ArtifactCorrupt, FilesMissing
from league.files import (
    check_digest,
    copy_verified,
    digests_of,
    disk_errors,
    files_in,
    flush,
    move_durably,
)
from league.registry.storage.manifest import MANIFEST, TRAINING, Manifest

STAGING = ".publishing-"
REMOVED = ".removed-"
"""Prefix of a training state that is being removed."""


class ArtifactStore:
    """A directory of artefacts on a disk shared by training, evaluation and serving."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def path(self, league: str, number: int) -> Path:
        """Return the directory of a published version."""
        return self.root / league / str(number)

    def last(self, league: str) -> int:
        """Return the highest number of a directory of the league, ready or not; 0 if there is none.

        It exceeds the numbers in the database if that was lost: such versions are left unchanged.
        """
        with disk_errors(self.root), suppress(FileNotFoundError):
            names = [path.name.removeprefix(STAGING) for path in (self.root / league).iterdir()]
            return max((int(name) for name in names if name.isdecimal()), default=0)
        return 0

    def stage(self, league: str, number: int) -> Path:
        """Create the empty staging directory of a version, on the disk of the final one."""
        staging = self._staging(league, number)
        with disk_errors(staging):
            staging.mkdir(parents=True)
        return staging

    def commit(self, manifest: Manifest) -> str:
        """Publish the staged files; returns the text of `manifest.json`.

        All files are flushed to the disk before the rename that makes the version visible.
        """
        staging = self._staging(manifest.league, manifest.version)
        target = self.path(manifest.league, manifest.version)
        with disk_errors(target):
            digests = digests_of(staging, (name for name in files_in(staging) if name != MANIFEST))
            text = manifest.model_copy(update={"files": digests}).to_json()
            (staging / MANIFEST).write_text(text, encoding="utf-8")
            move_durably(staging, target)
            flush(self.root)  # the entry of a new league
        return text

    def discard(self, league: str, number: int) -> None:
        """Remove all files of a version. Must not be called for a ready version."""
        for directory in (self._staging(league, number), self.path(league, number)):
            with disk_errors(directory), suppress(FileNotFoundError):
                shutil.rmtree(directory)

    def remove_training(self, league: str, number: int) -> None:
        """Remove the training state of a version, completely or not at all for those who read it."""
        removed = self.root / league / f"{REMOVED}{number}"
        with disk_errors(removed), suppress(FileNotFoundError):
            (self.path(league, number) / TRAINING).rename(removed)
        with disk_errors(removed), suppress(FileNotFoundError):
            shutil.rmtree(removed)

    def size(self, league: str, number: int) -> int:
        """Return the size of all files of a version, in bytes."""
        return _size(self.path(league, number))

    def training_size(self, league: str, number: int) -> int:
        """Return the size of a version's training state, in bytes, including a removal that was interrupted."""
        return _size(self.path(league, number) / TRAINING) + _size(self.root / league / f"{REMOVED}{number}")

    def is_purged(self, league: str, number: int) -> bool:
        """Return whether the directory of a version is missing but that of its league exists.

        If the league's directory is missing as well, the disk may not be mounted.
        """
        directory = self.path(league, number)
        with disk_errors(directory):
            return directory.parent.is_dir() and not directory.is_dir()

    def check_exists(self, league: str, number: int) -> None:
        """Raise FilesMissing if all files of a version are missing, although the registry has the version."""
        directory = self.path(league, number)
        with disk_errors(directory):
            if not directory.is_dir():
                raise files_missing(league, number, str(directory))

    def has_folder(self, league: str, number: int, folder: str) -> bool:
        """Return whether a version has files in a folder."""
        return (self.path(league, number) / folder).is_dir()

    def verify_names(self, league: str, number: int, sha256: str) -> Manifest:
        """Return the manifest of a version after verifying that exactly the files that it names exist.

        The training state may be missing as a whole, after `remove_training`. The content of the files is not read:
        it can be large. `read` verifies it. Raises ArtifactCorrupt.
        """
        directory, manifest = self.path(league, number), self.manifest(league, number, sha256)
        with disk_errors(directory):
            present = set(files_in(directory)) - {MANIFEST}
            has_training = self.has_folder(league, number, TRAINING)
        for name in sorted(present - set(manifest.files)):
            raise ArtifactCorrupt(f"{label(league, number, name)} does not belong to {league}@{number}")
        for name in sorted(set(manifest.files) - present):
            if has_training or not name.startswith(f"{TRAINING}/"):
                check_digest(label(league, number, name), manifest.files[name], None)
        return manifest

    def manifest(self, league: str, number: int, sha256: str) -> Manifest:
        """Read the manifest of a version. Raises FilesMissing, or ArtifactCorrupt if its digest is not `sha256`."""
        content = self._verified(league, number, MANIFEST, sha256)
        return Manifest.from_json(content, source=label(league, number, MANIFEST))

    def read(self, manifest: Manifest, name: str) -> bytes:
        """Read and verify one file of a version. Raises ArtifactCorrupt."""
        if name not in manifest.files:
            raise ArtifactCorrupt(
                f"{manifest.league}@{manifest.version} has no file {name!r}, which its manifest names"
            )
        return self._verified(manifest.league, manifest.version, name, manifest.files[name])

    def copy(self, manifest: Manifest, folder: str, target: Path) -> None:
        """Copy the files of a folder of a version to the new directory `target`, each verified as it is copied.

        What the store contains later, which others may be able to change, has no influence. Raises ArtifactCorrupt.
        """
        names = {
            PurePosixPath(name).relative_to(folder).as_posix(): digest
            for name, digest in manifest.files.items()
            if name.startswith(f"{folder}/")
        }
        source = self.path(manifest.league, manifest.version) / folder
        copy_verified(source, names, target, label(manifest.league, manifest.version, folder))

    def _verified(self, league: str, number: int, name: str, digest: str) -> bytes:
        content = self._content(league, number, name, digest)
        if content is None:
            self.check_exists(league, number)
        check_digest(
            label(league, number, name), digest, None if content is None else hashlib.sha256(content).hexdigest()
        )
        assert content is not None
        return content

    def _content(self, league: str, number: int, name: str, digest: str) -> bytes | None:  # noqa: ARG002
        """Return a file, which is not verified. digest: for stores that cache by it."""
        path = self.path(league, number) / name
        with disk_errors(path):
            return path.read_bytes() if path.is_file() else None

    def _staging(self, league: str, number: int) -> Path:
        return self.root / league / f"{STAGING}{number}"


def _size(directory: Path) -> int:
    """Return the size of all files in a directory, in bytes; 0 if it does not exist."""
    with disk_errors(directory):
        return sum(path.lstat().st_size for path in directory.rglob("*") if not path.is_dir())


def files_missing(league: str, number: int, place: str) -> FilesMissing:
    """Return the error for a version whose directory, or URL, does not exist any more."""
    return FilesMissing(
        f"{label(league, number, MANIFEST)} is missing: {place} does not exist; mount its disk or restore it from a"
        f" backup, or remove the version by `league remove {league}@{number}` and publish it again"
    )


def label(league: str, number: int, name: str) -> str:
    """Return a file as messages name it: callers on other machines need not know where the store is."""
    return f"{league}/{number}/{name}"
