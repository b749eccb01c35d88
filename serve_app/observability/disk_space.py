"""Measures the free space of the disks that a replica's machine stores data on."""

import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from threading import Thread

from league.settings import Storage
from serve_app.observability.metrics import Report


class DiskSpace:
    """Free and total bytes of the disks of the home and of the artefact store, unless that is an object store.

    A network disk that does not respond blocks whoever asks for its size. Therefore a thread measures, and a disk
    without an answer has no samples.
    """

    def __init__(self, storage: Storage) -> None:
        disks = {"home": storage.home, "artifacts": storage.artifacts}
        self._paths: Mapping[str, Path] = {disk: path for disk, path in disks.items() if isinstance(path, Path)}
        self._sizes: dict[str, tuple[int, int]] = {}
        self._threads: dict[str, Thread] = {}

    def report(self) -> Report:
        """Return the last measured sizes, and start the next measurement."""
        sizes, self._sizes = self._sizes, {}
        for disk, path in self._paths.items():
            if disk not in self._threads or not self._threads[disk].is_alive():
                self._threads[disk] = Thread(target=self._measure, args=(disk, path), name="disk", daemon=True)
                self._threads[disk].start()
        return {
            "league_disk_free_bytes": [[[disk], free] for disk, (free, _) in sizes.items()],
            "league_disk_size_bytes": [[[disk], size] for disk, (_, size) in sizes.items()],
        }

    def _measure(self, disk: str, path: Path) -> None:
        with suppress(OSError):
            file_system = os.statvfs(path)
            # As `df` has it: the part that is reserved for root is neither free nor counted.
            free = file_system.f_bavail * file_system.f_frsize
            used = (file_system.f_blocks - file_system.f_bfree) * file_system.f_frsize
            self._sizes[disk] = free, used + free
