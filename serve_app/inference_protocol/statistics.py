"""Inference statistics of a replica by policy and version, in the protocol's format: counts and durations in
nanoseconds.

Each row counts as an inference, and each run of a graph as an execution, also if it answers several requests. There is
no cache; its fields are 0.
"""

import time
from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

REPORT = "open_inference_statistics"
"""The key of a replica's statistics in its report to the registry."""
MAX_ENTRIES = 1024
"""Maximum policies and versions with statistics; the least recently used are dropped."""


Document = dict[str, Any]


@dataclass(slots=True)
class Duration:
    """A count and the total duration."""

    count: int = 0
    ns: int = 0

    def add(self, ns: int) -> None:
        self.count += 1
        self.ns += ns

    def document(self) -> dict[str, int]:
        return {"count": self.count, "ns": self.ns}


@dataclass(slots=True)
class ModelStatistics:
    """Statistics of one version of one policy."""

    last_inference: int = 0
    """Milliseconds since the epoch; 0 before the first."""
    inference_count: int = 0
    execution_count: int = 0
    success: Duration = field(default_factory=Duration)
    failure: Duration = field(default_factory=Duration)
    queue: Duration = field(default_factory=Duration)
    """Waiting to be answered, and looking up the version. Clients such as perf_analyzer read from its count which
    version has answered."""
    input: Duration = field(default_factory=Duration)
    """Decoding and checking tensors."""
    infer: Duration = field(default_factory=Duration)
    """Running the graph, including the wait for a thread if the batch is large."""
    output: Duration = field(default_factory=Duration)
    """Encoding the response."""

    def fail(self, ns: int) -> None:
        """Count a request that failed after `ns` nanoseconds."""
        self.failure.add(ns)

    def succeed(self, rows: int, begun: int, found: int, read: int, ran: int, done: int, executions: int = 1) -> None:
        """Count a request of `rows` observations, and the runs for it; the other arguments are times in nanoseconds."""
        self.last_inference = time.time_ns() // 1_000_000
        self.inference_count += rows
        self.execution_count += executions
        self.success.add(done - begun)
        self.queue.add(found - begun)
        self.input.add(read - found)
        self.infer.add(ran - read)
        self.output.add(done - ran)

    def document(self, name: str, version: int) -> dict[str, Any]:
        """In the format of the statistics extension."""
        nothing = Duration().document()
        return {
            "name": name,
            "version": str(version),
            "last_inference": self.last_inference,
            "inference_count": self.inference_count,
            "execution_count": self.execution_count,
            "inference_stats": {
                "success": self.success.document(),
                "fail": self.failure.document(),
                "queue": self.queue.document(),
                "compute_input": self.input.document(),
                "compute_infer": self.infer.document(),
                "compute_output": self.output.document(),
                "cache_hit": nothing,
                "cache_miss": nothing,
            },
        }


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
        self._entries: OrderedDict[tuple[str, int], ModelStatistics] = OrderedDict()

    def entry(self, name: str, version: int) -> ModelStatistics:
        """The entry of a version, created if necessary."""
        key = (name, version)
        if (entry := self._entries.get(key)) is None:
            entry = self._entries[key] = ModelStatistics()
            if len(self._entries) > MAX_ENTRIES:
                self._entries.popitem(last=False)
        else:
            self._entries.move_to_end(key)
        return entry

    def documents(self, name: str | None = None, version: int | None = None) -> list[dict[str, Any]]:
        """The entries of a model and a version, by default all."""
        return [
            entry.document(of, number)
            for (of, number), entry in sorted(self._entries.items())
            if name in (None, of) and version in (None, number)
        ]
