"""Atomic and durable file writes, digests of files, and translation of disk errors."""

import errno
import hashlib
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from league.errors import ArtifactCorrupt, StorageError

FULL = 2**20
"""Free bytes below which a disk is considered full."""
DISK_FULL_OR_READ_ONLY = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM)


@contextmanager
def disk_errors(path: Path, only: tuple[int, ...] | None = None, action: str = "used") -> Iterator[None]:
    """Translate an OSError into a StorageError that names the file, or `path`.

    only: translate only these error numbers. action: what cannot be done with the file.
    """
    try:
        yield
    except OSError as error:
        if only is not None and error.errno not in only:
            raise
        name, reason = Path(error.filename or path), error.strerror or str(error)
        if isinstance(error, FileExistsError | FileNotFoundError) and name.is_symlink() and not name.exists():
            reason = f"it is a link to {name.readlink()}, which does not exist"
        raise StorageError(f"{name} cannot be {action}: {reason}") from error


def full_disk(path: Path) -> str | None:
    """Return that the disk of a file is full, or None if it is not."""
    free = free_space(path)
    return f"the disk of {path.parent} is full: {free:,} bytes are free" if free < FULL else None


def free_space(path: Path) -> int:
    """Return the free bytes of the disk of a file, which need not exist."""
    return shutil.disk_usage(next(parent for parent in path.absolute().parents if parent.is_dir())).free


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path` to write to, and rename it to `path` once it is on the disk.

    If the block raises, the temporary file is deleted and `path` is unchanged. An OSError names `path`.
    """
    draft = path.with_name(f".{path.name}.part")
    try:
        yield draft
        flush(draft)
        draft.replace(path)
    except BaseException as error:
        with suppress(OSError):
            draft.unlink()
        if isinstance(error, OSError) and str(error.filename) == str(draft):
            error.filename = str(path)
        raise


def move_durably(directory: Path, target: Path) -> None:
    """Rename a directory once all its content is on the disk: after a power failure, `target` is complete or absent."""
    for current, _, names in os.walk(directory, topdown=False):
        for name in names:
            flush(Path(current) / name)
        flush(Path(current))
    directory.rename(target)
    flush(target.parent)


def flush(path: Path) -> None:
    """Force a file, or the entries of a directory, to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file, 64 hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def files_in(directory: Path) -> list[str]:
    """Return the relative paths of all files in `directory`, sorted. A symbolic link counts as a file."""
    paths = [path for path in directory.rglob("*") if path.is_symlink() or not path.is_dir()]
    return sorted(path.relative_to(directory).as_posix() for path in paths)


def digests_of(directory: Path, names: Iterable[str]) -> dict[str, str]:
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
