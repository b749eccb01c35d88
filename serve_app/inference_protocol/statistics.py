"""Inference statistics of a replica by policy and version, in the protocol's format: counts and durations in
nanoseconds.

Each row counts as an inference, and each run of a graph as an execution, also if it answers several requests. There is
no cache; its fields are 0.
"""

import time
from collections.abc import Iterable
from copy import deepcopy
from typing import Any

REPORT = "open_inference_statistics"
"""The key of a replica's statistics in its report to the registry."""
MAX_ENTRIES = 1024
"""Maximum policies and versions with statistics; the least recently used are dropped."""


Document = dict[str, Any]
PARTS = ("success", "fail", "queue", "compute_input", "compute_infer", "compute_output", "cache_hit", "cache_miss")
"""Of these, `queue` is waiting to be answered, and looking up the version. Clients such as perf_analyzer read from its
count which version has answered."""


class ModelStatistics:
    """Statistics of one version of one policy. document: in the format of the statistics extension."""

    def __init__(self, name: str, version: int) -> None:
        self._durations = {part: {"count": 0, "ns": 0} for part in PARTS}
        self.document: Document = {
            "name": name,
            "version": str(version),
            "last_inference": 0,  # milliseconds since the epoch
            "inference_count": 0,
            "execution_count": 0,
            "inference_stats": self._durations,
        }

    def fail(self, ns: int) -> None:
        """Count a request that failed after `ns` nanoseconds."""
        self._add("fail", ns)

    def succeed(self, rows: int, begun: int, found: int, read: int, ran: int, done: int, executions: int = 1) -> None:
        """Count a request of `rows` observations, and the runs for it; the other arguments are times in nanoseconds."""
        self.document["last_inference"] = time.time_ns() // 1_000_000
        self.document["inference_count"] += rows
        self.document["execution_count"] += executions
        self._add("success", done - begun)
        self._add("queue", found - begun)
        self._add("compute_input", read - found)
        self._add("compute_infer", ran - read)
        self._add("compute_output", done - ran)

    def _add(self, part: str, ns: int) -> None:
        duration = self._durations[part]
        duration["count"] += 1
        duration["ns"] += ns


def sum_documents(documents: Iterable[Document]) -> list[Document]:
    """Sum the statistics of replicas by model and version; the last inference is the latest one."""
    sums: dict[tuple[str, int], Document] = {}
    for document in documents:
        key = (document["name"], int(document["version"]))
        sums[key] = _sum(sums[key], document) if key in sums else document
    return [sums[key] for key in sorted(sums)]


def _sum(one: Document, other: Document) -> Document:
    return {
        key: value
        if isinstance(value, str)
        else max(value, other[key])
        if key == "last_inference"
        else _sum(value, other[key])
        if isinstance(value, dict)
        else value + other[key]
        for key, value in one.items()
    }


class Statistics:
    """Statistics of a replica since it started."""

    def __init__(self) -> None:
        self._entries: dict[tuple[str, int], ModelStatistics] = {}
        """The most recently used last."""

    def entry(self, name: str, version: int) -> ModelStatistics:
        """The entry of a version, created if necessary."""
        entry = self._entries.pop((name, version), None) or ModelStatistics(name, version)
        self._entries[name, version] = entry
        if len(self._entries) > MAX_ENTRIES:
            del self._entries[next(iter(self._entries))]
        return entry

    def documents(self) -> list[Document]:
        """All entries."""
        return [deepcopy(entry.document) for _, entry in sorted(self._entries.items())]
