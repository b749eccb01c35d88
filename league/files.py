"""Atomic and durable file writes, and translation of their errors."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from league.errors import StorageError

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
        raise StorageError(f"{error.filename or path} cannot be {action}: {error.strerror or error}") from error


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
