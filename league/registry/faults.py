"""Faults of the disk as errors of one line."""

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from league.errors import StorageError

DISK_FULL_OR_SHUT = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM)


@contextmanager
def disk_faults(path: Path, only: tuple[int, ...] | None = None) -> Iterator[None]:
    """Turn an OSError (`only` those of these numbers) into a StorageError that names the file, or `path`."""
    try:
        yield
    except OSError as error:
        if only is not None and error.errno not in only:
            raise
        raise StorageError(f"{error.filename or path} cannot be used: {error.strerror or error}") from error
