"""Executes inference requests of the protocol, over REST and gRPC: resolves the policy, checks inputs, runs the
graph."""

import asyncio
from collections.abc import Callable, Iterable, Sequence
from time import perf_counter_ns
from typing import NamedTuple, TypeVar

from numpy.typing import NDArray

from league.errors import InvalidInput
from league.policies.onnx import ACTION, DIST_INPUTS, STATE_IN, STATE_OUT
from league.policies.policy import Actions
from league.refs import CHAMPION
from serve_app.codecs.request_limits import LARGE_BODY
from serve_app.inference.serving import Serving
from serve_app.inference_protocol.statistics import Statistics
from serve_app.inference_protocol.tensors import RequestTensor, read_inputs
from serve_app.live_versions.policies import ActionOptions, LoadedPolicy
from serve_app.live_versions.traffic_split import Headers

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


class Inference:
    """Executes inference requests of a replica. Runs on the event loop."""

    def __init__(self, serving: Serving) -> None:
        self.serving = serving
        self.statistics = Statistics()

    async def find(self, model: str, version: str, headers: Headers = ()) -> LoadedPolicy:
        """The policy that answers for a model. Raises the errors of `ModelResolver.find`."""
        return await self.serving.models.find(model, version or CHAMPION, headers)

    async def infer(self, request: InferRequest, encode: Callable[[InferResponse], T], headers: Headers = ()) -> T:
        """Execute a request and encode the response. Raises LeagueError.

        headers: those of the request; the caller's key may route a request for the champion to the canary.
        """
        start = perf_counter_ns()
        policy = await self.find(request.model, request.version, headers)
        lookup_end = perf_counter_ns()
        entry = self.statistics.entry(policy.model, policy.number)
        try:
            output_names = wanted_outputs(request.outputs, policy)
            if request.is_sequence and policy.state:
                raise InvalidInput("sequences are not supported: send state_out_<i> back as state_in_<i>")
            arrays = await self._read(request, policy)
            read = perf_counter_ns()
            state = {name: array for name, array in arrays.items() if policy.inputs[name].is_state} or None
            answer = await self.serving.act(policy, arrays, options_for(output_names), state)
            ran = perf_counter_ns()
            outputs = {name: output_of(name, answer) for name in output_names}
            response = InferResponse(request.model, str(policy.number), request.id, outputs)
            encoded = encode(response)
        except BaseException:
            entry.fail(perf_counter_ns() - start)
            raise
        rows = len(next(iter(arrays.values())))
        done = perf_counter_ns()
        entry.succeed(rows, start, lookup_end, read, ran, done)
        self.serving.count(API, policy, rows, start)
        return encoded

    async def _read(self, request: InferRequest, policy: LoadedPolicy) -> dict[str, NDArray]:
        max_batch = self.serving.settings.max_batch
        if request.size <= LARGE_BODY:
            return read_inputs(request.inputs, policy, max_batch)
        return await asyncio.to_thread(read_inputs, request.inputs, policy, max_batch)


def wanted_outputs(outputs: Sequence[str], policy: LoadedPolicy) -> Sequence[str]:
    """Names of the requested outputs. Raises InvalidInput."""
    if not outputs:
        return list(policy.outputs)
    for name in outputs:
        if name not in policy.outputs:
            raise InvalidInput(f"unknown output {name[:64]!r}, expected {', '.join(policy.outputs)}")
    if len(set(outputs)) < len(outputs):
        raise InvalidInput("an output is requested twice")
    return outputs


def options_for(outputs: Iterable[str]) -> ActionOptions:
    """How actions are chosen if these outputs are requested: always greedily."""
    return ActionOptions(explore=False, values="outputs" if DIST_INPUTS in outputs else None)


def output_of(name: str, answer: Actions) -> NDArray:
    """The output of a graph by its name in the protocol."""
    if name == ACTION:
        return answer.actions
    if name == DIST_INPUTS:
        assert answer.dist_inputs is not None
        return answer.dist_inputs
    assert answer.state is not None
    return answer.state[STATE_IN + name.removeprefix(STATE_OUT)]
