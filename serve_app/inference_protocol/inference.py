"""One inference, however it was asked for: find the policy, check the tensors, run the graph, count what it took."""

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
from serve_app.inference_protocol.signature import Signature, signature_of
from serve_app.inference_protocol.statistics import Statistics
from serve_app.inference_protocol.tensors import Tensor, read_inputs
from serve_app.loading import LoadedPolicy, LoadedVersion
from serve_app.models import Models, policy_ref
from serve_app.settings import ServeSettings

T = TypeVar("T")


class InferRequest(NamedTuple):
    """What is asked, of whom."""

    model: str
    version: str
    """A number or an alias; empty for the champion."""
    id: str
    inputs: Sequence[Tensor]
    outputs: Sequence[str]
    """Names of the outputs that are wanted; none means all."""
    is_sequence: bool = False
    """Whether the server is asked to keep state between requests."""


class InferResponse(NamedTuple):
    """What is answered."""

    model: str
    version: str
    id: str
    outputs: dict[str, NDArray]
    """In the order in which they were asked for."""


class Served(NamedTuple):
    """A policy with what the protocol says of it."""

    name: str
    """`{league}`, or `{league}.{policy}` where a version has several policies."""
    version: LoadedVersion
    policy: LoadedPolicy
    signature: Signature


class Inference:
    """The policies of a replica under the protocol. Runs on the event loop."""

    def __init__(self, models: Models, settings: ServeSettings) -> None:
        self._models = models
        self._settings = settings
        self._signatures: WeakKeyDictionary[LoadedPolicy, Signature] = WeakKeyDictionary()
        self.statistics = Statistics()
        self.in_flight = 0
        """Requests that were begun and not answered yet."""

    @contextmanager
    def admitted(self) -> Iterator[None]:
        """Count a request while it is in progress. Raises Overloaded."""
        if self.in_flight >= self._settings.max_in_flight:
            raise Overloaded(f"{self.in_flight} requests are in progress here already")
        self.in_flight += 1
        try:
            yield
        finally:
            self.in_flight -= 1

    async def find(self, model: str, version: str) -> Served:
        """What answers for a model. Raises what `Models.find` raises."""
        loaded, policy = await self._models.find(model, version or CHAMPION)
        signature = self._signatures.get(policy)
        if signature is None:
            signature = self._signatures[policy] = signature_of(policy.manifest)
        name = loaded.league if len(loaded.policies) == 1 else str(policy_ref(model))
        return Served(name, loaded, policy, signature)

    async def infer(self, request: InferRequest, encode: Callable[[InferResponse], T]) -> T:
        """Answer a request in the form that `encode` gives it. Raises LeagueError."""
        begun = perf_counter_ns()
        served = await self.find(request.model, request.version)
        found = perf_counter_ns()
        entry = self.statistics.entry(served.name, served.version.number)
        try:
            wanted = _wanted(request.outputs, served.signature)
            if request.is_sequence and served.signature.is_recurrent:
                raise InvalidInput("no state is kept between requests: send state_out_<i> back as state_in_<i>")
            arrays = read_inputs(request.inputs, served.signature, self._settings.max_batch)
            read = perf_counter_ns()
            outputs = await _run(arrays, wanted, served)
            ran = perf_counter_ns()
            response = InferResponse(request.model, str(served.version.number), request.id, outputs)
            encoded = encode(response)
        except BaseException:
            entry.fail(perf_counter_ns() - begun)
            raise
        rows = len(next(iter(arrays.values())))
        entry.succeed(rows, begun, found, read, ran, perf_counter_ns())
        return encoded


def _wanted(outputs: Sequence[str], signature: Signature) -> Sequence[str]:
    """Raises InvalidInput."""
    if not outputs:
        return list(signature.outputs)
    for name in outputs:
        if name not in signature.outputs:
            raise InvalidInput(f"there is no output {name[:64]!r}, expected {', '.join(signature.outputs)}")
    if len(set(outputs)) < len(outputs):
        raise InvalidInput("an output is asked for twice")
    return outputs


async def _run(arrays: dict[str, NDArray], wanted: Sequence[str], served: Served) -> dict[str, NDArray]:
    ports, policy = served.signature.inputs, served.policy.policy
    state = {name: array for name, array in arrays.items() if ports[name].is_state} or None

    def act() -> Actions:
        if DIST_INPUTS in wanted:
            return policy.distribution(arrays, state=state)
        return policy.act(arrays, state=state)

    rows = len(next(iter(arrays.values())))
    answer = act() if rows <= served.policy.inline_rows else await asyncio.to_thread(act)
    return {name: _output(name, answer) for name in wanted}


def _output(name: str, answer: Actions) -> NDArray:
    if name == ACTION:
        return answer.actions
    if name == DIST_INPUTS:
        assert answer.dist_inputs is not None
        return answer.dist_inputs
    assert answer.state is not None
    return answer.state[STATE_IN + name.removeprefix(STATE_OUT)]
