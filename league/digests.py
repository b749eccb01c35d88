"""SHA-256 digests of files: computed, and verified before a file is used."""

import hashlib
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path

from league.errors import ArtifactCorrupt
from league.files import disk_errors


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file, 64 hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def files(directory: Path) -> list[str]:
    """Return the relative paths of all files in `directory`, sorted. A symbolic link counts as a file."""
    found = [path for path in directory.rglob("*") if path.is_symlink() or not path.is_dir()]
    return sorted(path.relative_to(directory).as_posix() for path in found)


def of_files(directory: Path, names: Iterable[str]) -> dict[str, str]:
    """Return relative path → SHA-256 of some files in `directory`."""
    return {name: file_sha256(directory / name) for name in names}


def copy_verified(source: Path, digests: Mapping[str, str], target: Path, name: str) -> None:
    """Copy the files in `digests` from `source` to the new directory `target`, and verify the copies.

    Only this account can access `target`. A later change of `source`, which others may be able to write to, has no
    influence.

    Args:
        source: Directory of the files.
        digests: Relative path → expected SHA-256.
        target: Directory of the copies.
        name: Name of `source` in errors.

    Raises:
        ArtifactCorrupt: A file is missing, not a regular file, or was changed.
    """
    with disk_errors(target):
        target.mkdir(mode=0o700)
    for path, digest in digests.items():
        copied = target / path
        with disk_errors(copied):
            copied.parent.mkdir(parents=True, exist_ok=True)
            is_file = (source / path).is_file()
            if is_file:
                shutil.copyfile(source / path, copied)
            check_digest(f"{name}/{path}", digest, file_sha256(copied) if is_file else None)


def check_digest(name: str, expected: str, found: str | None) -> None:
    """Raise ArtifactCorrupt, which names the file, unless its digest is the expected one. found: None if missing."""
    if found is None:
        raise ArtifactCorrupt(f"{name} is missing or not a regular file")
    if found != expected:
        raise ArtifactCorrupt(f"{name} was changed: its SHA-256 is {found[:12]}…, expected {expected[:12]}…")
