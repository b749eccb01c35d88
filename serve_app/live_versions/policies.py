"""A policy in memory: who it is, what goes in and out of its graph, and how it runs."""

import asyncio
import math
import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import InitVar, dataclass, field
from functools import lru_cache
from math import prod
from typing import Literal, NamedTuple

import numpy as np
import orjson

from league.conditions import ActionSelection
from league.errors import GraphTimeout, InvalidInput, UnknownPolicy
from league.policies.onnx import ACTION, DIST_INPUTS, STATE_OUT, OnnxPolicy
from league.policies.open_inference import DATATYPES
from league.policies.policy import Actions, Arrays
from league.random.seeds import generator
from league.registry.storage.manifest import Mixture, PolicyManifest, Tensor
from league.spaces import ACTION_MASK, Box, Leaf, inputs
from league.spaces.observation_codec import ObservationReader
from serve_app.codecs.request_limits import RequestLimits
from serve_app.live_versions.remote_search import SEARCHES, RemoteSearch

SHADOW_TIMEOUT = 1.0
"""Seconds after which a run of a shadow is ended, and counted as failed."""
INLINE_TIMEOUT = 0.5
"""Seconds after which a run on the event loop is ended, and repeated in a thread."""
RUNS_IN_THREADS = min(32, (os.cpu_count() or 1) + 4) // 2
"""Runs of one policy in threads at a time: half of the threads of asyncio's default executor, so that a slow policy
leaves the others to the rest of the replica."""

ActionSelections = dict[str, ActionSelection]
"""league → how its versions select actions if a request does not say. All of them share it, so that a change reaches
all at once."""

Graph = OnnxPolicy | RemoteSearch
"""What computes the actions of a policy."""


class Port(NamedTuple):
    """An input or output of a graph."""

    name: str
    leaf: Leaf
    """Shape of a row, dtype, and permitted values."""
    datatype: str
    """That of the Open Inference Protocol."""
    dtype: np.dtype
    """That of its elements in bytes: little-endian."""
    row_bytes: int
    is_state: bool
    """Whether it is recurrent state, which may be omitted at the start of an episode."""

    @classmethod
    def of(cls, name: str, leaf: Leaf, is_state: bool = False) -> "Port":
        """An input or output whose rows are of a leaf."""
        dtype = np.dtype(leaf.dtype).newbyteorder("<")
        return cls(name, leaf, DATATYPES[leaf.dtype], dtype, prod(leaf.shape) * dtype.itemsize, is_state)

    @classmethod
    def of_tensor(cls, tensor: Tensor, is_state: bool = False) -> "Port":
        """An input or output of a manifest, in which the batch is the only dimension without a fixed size."""
        shape = tuple(size for size in tensor.shape[1:] if size is not None)
        return cls.of(tensor.name, Box(dtype=tensor.dtype, shape=shape, low=None, high=None), is_state)


Ports = dict[str, Port]
"""By name, in the order of the manifest."""


def input_ports(manifest: PolicyManifest) -> Ports:
    """The leaves of the observation, then the recurrent state."""
    observed = {name: Port.of(name, leaf) for name, leaf in inputs(manifest.observation).items()}
    return observed | {tensor.name: Port.of_tensor(tensor, is_state=True) for tensor in manifest.state}


def output_ports(manifest: PolicyManifest) -> Ports:
    """The fields of `Actions`."""
    return {
        tensor.name: Port.of_tensor(tensor)
        for tensor in manifest.outputs
        if tensor.name in (ACTION, DIST_INPUTS) or tensor.name.startswith(STATE_OUT)
    }


class ActionOptions(NamedTuple):
    """How the actions of a request are chosen, and what is returned with them."""

    explore: bool | None = None
    """Whether to sample the actions; None for the league's default."""
    seed: int | list[int] | None = None
    """Of all rows, or one for each of them."""
    values: Literal["distribution", "outputs"] | None = None
    """What `dist_inputs` of the answer are: inputs of the distribution, of a certain one if the graph has none; or the
    output of the graph."""
    deadline: float = math.inf
    """When a search ends with the best actions so far, a time of `time.monotonic`; infinity for all simulations."""
    analysis: bool = False
    """Whether to return what a search expects."""

    def generators(self, rows: int) -> Sequence[np.random.Generator]:
        """One generator per row, so that an action does not depend on the batch."""
        if self.seed is None:
            return [np.random.default_rng() for _ in range(rows)]
        if isinstance(self.seed, list):
            return [generator(seed, 0) for seed in self.seed]
        return [generator(self.seed, row) for row in range(rows)]


@dataclass(slots=True, eq=False, weakref_slot=True)
class LoadedPolicy:
    """One policy of a version, ready for inference.

    is_only: whether its version has no other policy.
    """

    league: str
    number: int
    """That of its version."""
    sha256: str
    """Digest of the version's manifest.json, which contains the digests of all its files."""
    name: str
    is_only: InitVar[bool]
    manifest: PolicyManifest
    graph: Graph
    selections: ActionSelections
    inline_rows: int
    """The largest batch that is fast enough to run on the event loop. 0 after one was not."""
    model: str = field(init=False)
    """Its name in requests: `{league}`, or `{league}.{policy}` if its version has several policies."""
    inputs: Ports = field(init=False)
    observed: tuple[Port, ...] = field(init=False)
    """The inputs without the recurrent state."""
    state: tuple[tuple[str, Leaf], ...] = field(init=False)
    """The recurrent inputs; empty for a feed-forward policy."""
    outputs: Ports = field(init=False)
    reader: ObservationReader = field(init=False)
    limits: RequestLimits = field(init=False)
    inline_graph: Graph = field(init=False)
    """The graph for runs on the event loop."""
    shadow_graph: Graph = field(init=False)
    """The graph for runs of a shadow."""
    _threads: asyncio.Semaphore = field(init=False)

    def __post_init__(self, is_only: bool) -> None:
        self.model = self.league if is_only else self.qualified
        self.inputs, self.outputs = input_ports(self.manifest), output_ports(self.manifest)
        self.observed = tuple(port for port in self.inputs.values() if not port.is_state)
        self.state = tuple((port.name, port.leaf) for port in self.inputs.values() if port.is_state)
        self.reader = ObservationReader(self.manifest.observation)
        self.limits = RequestLimits.of(port.leaf for port in self.inputs.values())
        self._threads = asyncio.Semaphore(SEARCHES if self.search is not None else RUNS_IN_THREADS)
        self.inline_graph = self.graph.within(INLINE_TIMEOUT)
        self.shadow_graph = self.graph.within(SHADOW_TIMEOUT)

    @property
    def qualified(self) -> str:
        """`{league}.{policy}`, its name in state tokens."""
        return f"{self.league}.{self.name}"

    @property
    def is_masked(self) -> bool:
        """Whether an action mask is a part of its observations."""
        return ACTION_MASK in self.inputs

    @property
    def search(self) -> RemoteSearch | None:
        """The graph if it searches."""
        return self.graph if isinstance(self.graph, RemoteSearch) else None

    @property
    def samples(self) -> bool:
        """Whether actions are sampled if a request does not say, as in the league's matches."""
        return self.graph.has_distribution and self.selections[self.league] == "sampled"

    def is_sampled(self, options: ActionOptions) -> bool:
        """Whether the actions of a request are sampled."""
        return self.samples if options.explore is None else options.explore

    async def act(self, arrays: Arrays, options: ActionOptions, state: Arrays | None = None) -> Actions:
        """Choose actions, in a thread if the batch is large.

        arrays: the inputs of the graph, with or without the state. Raises LeagueError.
        """
        if options.analysis and self.search is None:
            raise InvalidInput("analysis is true, but this version does not search")
        if _rows(arrays) <= self.inline_rows:
            with suppress(GraphTimeout):
                return self.act_inline(arrays, options, state)
        async with self._threads:
            threads = None if self.search is None else self.search.threads
            return await asyncio.get_running_loop().run_in_executor(
                threads, self._act, self.graph, arrays, options, state
            )

    def act_inline(self, arrays: Arrays, options: ActionOptions, state: Arrays | None = None) -> Actions:
        """Choose actions on the event loop. Raises LeagueError."""
        try:
            return self._act(self.inline_graph, arrays, options, state)
        except GraphTimeout:
            self.inline_rows = 0
            raise

    def _act(self, graph: Graph, arrays: Arrays, options: ActionOptions, state: Arrays | None) -> Actions:
        if isinstance(graph, RemoteSearch):
            graph = graph.bounded(options.deadline, options.analysis)
        if self.is_sampled(options):
            return graph.act(arrays, state=state, explore=True, rng=options.generators(_rows(arrays)))
        if options.values == "distribution":
            return graph.distribution(arrays, state=state)
        return (graph.act if options.values is None else graph.outputs)(arrays, state=state)

    def signature(self, model: str) -> bytes:
        """The rest of a JSON response after its first fields. model: as in the request."""
        return _signature(model, self.number, self.sha256)


def _rows(arrays: Arrays) -> int:
    return len(next(iter(arrays.values())))


@lru_cache(maxsize=1024)
def _signature(model: str, version: int, sha256: str) -> bytes:
    return b"," + orjson.dumps({"model": model, "version": version, "sha256": sha256})[1:]


@dataclass(frozen=True, slots=True)
class LoadedVersion:
    """A version of a league, verified, loaded and warmed up."""

    league: str
    number: int
    sha256: str
    """Digest of the version's manifest.json, which contains the digests of all its files."""
    policies: dict[str, LoadedPolicy]
    mixture: Mixture | None = None
    """The members of a mixture and their probabilities; None for other versions."""
    members: tuple["LoadedVersion", ...] = ()
    """The loaded members of a mixture, in the same order. They act in its place."""

    def policy(self, name: str | None) -> LoadedPolicy:
        """A policy by name; None selects the only policy. Raises UnknownPolicy."""
        if name is None and len(self.policies) == 1:
            return next(iter(self.policies.values()))
        if name not in self.policies:
            problem = f"has no policy {name!r}" if name else f"has several policies: request {self.league}.POLICY"
            raise UnknownPolicy(f"{self.league}@{self.number} {problem}; known: {', '.join(self.policies)}")
        return self.policies[name]
