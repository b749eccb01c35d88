"""What a replica has inferred, by policy and version, in the protocol's terms: counts, and time in nanoseconds.

An inference counts once for each of its rows, an execution once for each run of a graph. Nothing waits in a queue, and
nothing is cached; the protocol's places for both hold 0.
"""

import time
from collections import OrderedDict
from dataclasses import dataclass, field
from typing import Any

KEPT = 1024
"""Policies and versions of which something is kept; those that were not asked for longest are forgotten."""


@dataclass(slots=True)
class Duration:
    """How often something was done, and how long that took altogether."""

    count: int = 0
    ns: int = 0

    def add(self, ns: int) -> None:
        self.count += 1
        self.ns += ns

    def document(self) -> dict[str, int]:
        return {"count": self.count, "ns": self.ns}


@dataclass(slots=True)
class Entry:
    """One version of one policy."""

    last_inference: int = 0
    """Milliseconds since 1970; 0 before the first."""
    inference_count: int = 0
    success: Duration = field(default_factory=Duration)
    failure: Duration = field(default_factory=Duration)
    input: Duration = field(default_factory=Duration)
    """Reading and checking tensors."""
    infer: Duration = field(default_factory=Duration)
    """Running the graph, with the wait for a thread if the batch is large."""
    output: Duration = field(default_factory=Duration)
    """Making the reply."""

    def fail(self, ns: int) -> None:
        """A request was refused or failed after `ns` nanoseconds."""
        self.failure.add(ns)

    def succeed(self, rows: int, begun: int, found: int, read: int, ran: int, done: int) -> None:
        """A request of `rows` observations was answered; the others are points in time, in nanoseconds."""
        self.last_inference = time.time_ns() // 1_000_000
        self.inference_count += rows
        self.success.add(done - begun)
        self.input.add(read - found)
        self.infer.add(ran - read)
        self.output.add(done - ran)

    def document(self, name: str, version: int) -> dict[str, Any]:
        """As the statistics extension has it."""
        nothing = Duration().document()
        return {
            "name": name,
            "version": str(version),
            "last_inference": self.last_inference,
            "inference_count": self.inference_count,
            "execution_count": self.infer.count,
            "inference_stats": {
                "success": self.success.document(),
                "fail": self.failure.document(),
                "queue": nothing,
                "compute_input": self.input.document(),
                "compute_infer": self.infer.document(),
                "compute_output": self.output.document(),
                "cache_hit": nothing,
                "cache_miss": nothing,
            },
        }


class Statistics:
    """The entries of a replica, since it started."""

    def __init__(self) -> None:
        self._entries: OrderedDict[tuple[str, int], Entry] = OrderedDict()

    def entry(self, name: str, version: int) -> Entry:
        """The entry to count in; made if need be."""
        key = (name, version)
        if (entry := self._entries.get(key)) is None:
            entry = self._entries[key] = Entry()
            if len(self._entries) > KEPT:
                self._entries.popitem(last=False)
        else:
            self._entries.move_to_end(key)
        return entry

    def documents(self, name: str | None = None, version: int | None = None) -> list[dict[str, Any]]:
        """The entries of a model and a version, by default of all."""
        return [
            entry.document(of, number)
            for (of, number), entry in sorted(self._entries.items())
            if name in (None, of) and version in (None, number)
        ]
