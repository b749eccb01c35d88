"""Executes inference requests of the protocol, over REST and gRPC: resolves the policy, checks inputs, runs the
graph."""

import asyncio
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from time import perf_counter_ns
from typing import NamedTuple, TypeVar
from weakref import WeakKeyDictionary

from numpy.typing import NDArray

from league.errors import InvalidInput, Overloaded
from league.policies.onnx import ACTION, DIST_INPUTS, STATE_IN, STATE_OUT
from league.policies.policy import Actions
from league.refs import CHAMPION
from serve_app.codecs.request_limits import LARGE_BODY
from serve_app.inference_protocol.statistics import Statistics
from serve_app.inference_protocol.tensors import RequestTensor, Signature, read_inputs, signature_of
from serve_app.live_versions.resolver import ModelResolver, policy_ref
from serve_app.live_versions.shadow import MirrorFunction, Shadow
from serve_app.live_versions.traffic_split import Headers
from serve_app.live_versions.version_cache import Graph, LoadedPolicy, LoadedVersion
from serve_app.observability.metrics import Metrics
from serve_app.settings import ServeSettings

T = TypeVar("T")
API = "infer"
"""Name of inference requests in metrics."""


class InferRequest(NamedTuple):
    """An inference request."""

    model: str
    version: str
    """A number or an alias; empty for the champion."""
    id: str
    inputs: Sequence[RequestTensor]
    outputs: Sequence[str]
    """Names of the requested outputs; all if empty."""
    size: int
    """Bytes of the request."""
    is_sequence: bool = False
    """Whether the client expects the server to keep state between requests."""


class InferResponse(NamedTuple):
    """An inference response."""

    model: str
    version: str
    id: str
    outputs: dict[str, NDArray]
    """In the requested order."""


class ProtocolModel(NamedTuple):
    """A policy with its signature in the protocol."""

    name: str
    """`{league}`, or `{league}.{policy}` if a version has several policies."""
    version: LoadedVersion
    policy: LoadedPolicy
    signature: Signature


class Inference:
    """Executes inference requests of a replica. Runs on the event loop."""

    def __init__(self, models: ModelResolver, shadow: Shadow, metrics: Metrics, settings: ServeSettings) -> None:
        self._models = models
        self._shadow = shadow
        self.metrics = metrics
        self._settings = settings
        self._signatures: WeakKeyDictionary[LoadedPolicy, Signature] = WeakKeyDictionary()
        self.statistics = Statistics()
        self.in_flight = 0
        """Requests in flight."""

    @contextmanager
    def admitted(self) -> Iterator[None]:
        """Count a request while it is in progress. Raises Overloaded."""
        if self.in_flight >= self._settings.max_in_flight:
            raise Overloaded(f"{self.in_flight} requests are in progress in this replica")
        self.in_flight += 1
        try:
            yield
        finally:
            self.in_flight -= 1

    async def find(self, model: str, version: str, headers: Headers = ()) -> ProtocolModel:
        """The policy that answers for a model. Raises the errors of `ModelResolver.find`."""
        return self.of_loaded(model, *await self._models.find(model, version or CHAMPION, headers))

    def of_loaded(self, model: str, loaded: LoadedVersion, policy: LoadedPolicy) -> ProtocolModel:
        """What `find` returns for a policy that is in memory."""
        signature = self._signatures.get(policy)
        if signature is None:
            signature = self._signatures[policy] = signature_of(policy.manifest)
        name = loaded.league if len(loaded.policies) == 1 else str(policy_ref(model))
        return ProtocolModel(name, loaded, policy, signature)

    async def infer(self, request: InferRequest, encode: Callable[[InferResponse], T], headers: Headers = ()) -> T:
        """Execute a request and encode the response. Raises LeagueError.

        headers: those of the request; the caller's key may route a request for the champion to the canary.
        """
        start = perf_counter_ns()
        served = await self.find(request.model, request.version, headers)
        mirror = self._shadow.mirror_for(request.model, served.version)
        lookup_end = perf_counter_ns()
        entry = self.statistics.entry(served.name, served.version.number)
        try:
            output_names = wanted_outputs(request.outputs, served.signature)
            if request.is_sequence and served.signature.is_recurrent:
                raise InvalidInput("sequences are not supported: send state_out_<i> back as state_in_<i>")
            arrays = await self._read(request, served.signature)
            read = perf_counter_ns()
            outputs = await _run(arrays, output_names, served, mirror)
            ran = perf_counter_ns()
            response = InferResponse(request.model, str(served.version.number), request.id, outputs)
            encoded = encode(response)
        except BaseException:
            entry.fail(perf_counter_ns() - start)
            raise
        rows = len(next(iter(arrays.values())))
        done = perf_counter_ns()
        entry.succeed(rows, start, lookup_end, read, ran, done)
        self.metrics.count_request(API, request.model, served.version, rows, done - start)
        return encoded

    async def _read(self, request: InferRequest, signature: Signature) -> dict[str, NDArray]:
        if request.size <= LARGE_BODY:
            return read_inputs(request.inputs, signature, self._settings.max_batch)
        return await asyncio.to_thread(read_inputs, request.inputs, signature, self._settings.max_batch)


def wanted_outputs(outputs: Sequence[str], signature: Signature) -> Sequence[str]:
    """Names of the requested outputs. Raises InvalidInput."""
    if not outputs:
        return list(signature.outputs)
    for name in outputs:
        if name not in signature.outputs:
            raise InvalidInput(f"unknown output {name[:64]!r}, expected {', '.join(signature.outputs)}")
    if len(set(outputs)) < len(outputs):
        raise InvalidInput("an output is requested twice")
    return outputs


async def _run(
    arrays: dict[str, NDArray], wanted: Sequence[str], served: ProtocolModel, mirror: MirrorFunction | None
) -> dict[str, NDArray]:
    ports = served.signature.inputs
    state = {name: array for name, array in arrays.items() if ports[name].is_state} or None

    def act(policy: Graph) -> Actions:
        if DIST_INPUTS in wanted:
            return policy.outputs(arrays, state=state)
        return policy.act(arrays, state=state)

    answer = await served.policy.run(act, len(next(iter(arrays.values()))))
    if mirror is not None:
        mirror({name: array for name, array in arrays.items() if not ports[name].is_state}, state, answer.actions)
    return {name: output_of(name, answer) for name in wanted}


def output_of(name: str, answer: Actions) -> NDArray:
    """The output of a graph by its name in the protocol."""
    if name == ACTION:
        return answer.actions
    if name == DIST_INPUTS:
        assert answer.dist_inputs is not None
        return answer.dist_inputs
    assert answer.state is not None
    return answer.state[STATE_IN + name.removeprefix(STATE_OUT)]
