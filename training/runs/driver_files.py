"""Files of a run on the driver's machine, for a learner that may run on another one.

A run's directory is on the driver's machine: the driver publishes its checkpoints. A learner on another machine writes
a checkpoint to a private directory and sends it, so that machines need not share a file system.
"""

import shutil
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import ray
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from league.files import files_in, move_durably
from league.ray_cluster import alive_nodes, has_autoscaler

CHUNK = 8 * 2**20
"""Bytes of a file that are sent at once. Ray's object store has at least 75 MiB."""
POLL = 1.0
"""Polling interval in seconds for a file on another machine."""


class DriverFiles:
    """The files, as seen on the driver's machine."""

    def fetch(self, directory: Path) -> Path:
        """Return a directory on this machine with the files of `directory`."""
        return directory

    def draft(self, target: Path) -> Path:
        """Return an unused path on this machine for the content of `target`."""
        path = target.with_name(f"{target.name}.part")
        shutil.rmtree(path, ignore_errors=True)
        return path

    def commit(self, draft: Path, target: Path) -> None:
        """Make `target` the directory `draft`: completely, or not at all."""
        move_durably(draft, target)

    def exists(self, path: Path) -> bool:
        """Return whether a file exists."""
        return path.exists()

    def keep_only(self, directory: Path) -> None:
        """Remove all siblings of `directory`."""
        for other in directory.parent.iterdir():
            if other != directory:
                shutil.rmtree(other)

    def close(self) -> None:
        """Release what this object uses."""


class FileActor(DriverFiles):
    """A Ray actor that reads and writes files on the driver's machine. It ends with the driver."""

    def files_in(self, directory: Path) -> list[str]:
        return files_in(directory)

    def read(self, path: Path, start: int) -> bytes:
        """Return the next CHUNK bytes from `start`, fewer at the end."""
        with path.open("rb") as file:
            file.seek(start)
            return file.read(CHUNK)

    def append(self, path: Path, content: bytes) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab") as file:
            file.write(content)


class RemoteDriverFiles(DriverFiles):
    """The files, as seen from another machine."""

    def __init__(self, actor: Any) -> None:
        self._actor = actor
        self._private = Path(tempfile.mkdtemp(prefix="league-learner-"))
        self._looked: dict[Path, tuple[float, bool]] = {}

    def fetch(self, directory: Path) -> Path:
        copy = self._private / directory.name
        shutil.rmtree(copy, ignore_errors=True)
        for name in ray.get(self._actor.files_in.remote(directory)):
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            with (copy / name).open("wb") as file:
                while content := ray.get(self._actor.read.remote(directory / name, file.tell())):
                    file.write(content)
        return copy

    def draft(self, target: Path) -> Path:
        return super().draft(self._private / target.name)

    def commit(self, draft: Path, target: Path) -> None:
        there = ray.get(self._actor.draft.remote(target))
        for name in files_in(draft):
            for content in _chunks(draft / name):
                ray.get(self._actor.append.remote(there / name, content))
        ray.get(self._actor.commit.remote(there, target))
        shutil.rmtree(draft)

    def exists(self, path: Path) -> bool:
        when, answer = self._looked.get(path, (-POLL, False))
        if time.monotonic() - when >= POLL:
            answer = ray.get(self._actor.exists.remote(path))
            self._looked[path] = time.monotonic(), answer
        return answer

    def keep_only(self, directory: Path) -> None:
        ray.get(self._actor.keep_only.remote(directory))

    def close(self) -> None:
        shutil.rmtree(self._private, ignore_errors=True)


def _chunks(path: Path) -> Iterator[bytes]:
    """The content of a file in chunks; one empty chunk for an empty file."""
    with path.open("rb") as file:
        yield file.read(CHUNK)
        while content := file.read(CHUNK):
            yield content


@dataclass(frozen=True, slots=True)
class DriverMachine:
    """The driver's machine, for processes anywhere in the cluster. node: its id in Ray. actor: a FileActor on it."""

    node: str
    actor: Any

    def files(self) -> DriverFiles:
        """Return its files for the process that calls this."""
        is_here = ray.get_runtime_context().get_node_id() == self.node
        return DriverFiles() if is_here else RemoteDriverFiles(self.actor)


def driver_machine() -> DriverMachine | None:
    """Return this machine, None if it is the only one of its cluster and stays so."""
    if len(alive_nodes()) == 1 and not has_autoscaler():
        return None
    node = ray.get_runtime_context().get_node_id()
    strategy = NodeAffinitySchedulingStrategy(node, soft=False)
    return DriverMachine(node, ray.remote(FileActor).options(num_cpus=0, scheduling_strategy=strategy).remote())
