"""Records of runs and sweeps on disk: whole or as before, and one process at a time works on what they are of."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout
from pydantic import BaseModel

from league.errors import AlreadyRunning


def write(record: BaseModel, path: Path) -> None:
    """Replace the record at `path` in one step."""
    draft = path.with_name(f".{path.name}")
    with draft.open("w") as file:
        file.write(record.model_dump_json(indent=2, by_alias=True))
        file.flush()
        os.fsync(file.fileno())
    draft.replace(path)


@contextmanager
def locked(directory: Path, what: str) -> Iterator[None]:
    """Keep other processes off `directory`. Raises AlreadyRunning. A process that dies lets go."""
    lock = FileLock(directory / "lock", timeout=0)
    try:
        lock.acquire()
    except Timeout as error:
        raise AlreadyRunning(f"{what} is under way in another process") from error
    try:
        yield
    finally:
        lock.release()
