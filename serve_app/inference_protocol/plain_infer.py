"""Plain requests of the Open Inference Protocol: all inputs are binary, and there is no recurrent state.

A caller sends nearly the same JSON each time. What it says, and what does not depend on the tensors (names, datatypes,
shapes, sizes), is parsed and checked once, by the application's own functions, and kept by the bytes of the JSON.
"""

from collections.abc import Sequence
from itertools import chain
from time import perf_counter_ns
from typing import NamedTuple
from weakref import WeakKeyDictionary

from league.policies.policy import Actions
from serve_app.inference.action_request import Arrays
from serve_app.inference.plain_format import PlainRequest, Target, Times
from serve_app.inference.stream_codec import observations_of
from serve_app.inference_protocol.inference import (
    API,
    Inference,
    InferResponse,
    options_for,
    output_of,
    wanted_outputs,
)
from serve_app.inference_protocol.rest import BINARY, HEADER_LENGTH, JSON, framing
from serve_app.inference_protocol.rest_codec import MIN_COMPRESSED_BYTES, RestRequest, read_request, write_response
from serve_app.inference_protocol.tensors import read_inputs
from serve_app.live_versions.policies import ActionOptions, LoadedPolicy
from serve_app.live_versions.traffic_split import Headers

MAX_HEAD = 1024
"""Bytes of the largest JSON that is kept."""
MAX_HEADS = 64
"""JSON texts that are kept for a policy: callers can send any."""


class Layout(NamedTuple):
    """What the JSON of a request says. begin, size: of its tensors in the body, in the order of the policy's inputs."""

    request: RestRequest
    outputs: Sequence[str]
    tensors: Sequence[slice]
    size: int
    rows: int


class BinaryTensors(NamedTuple):
    """The content of a request. tensors: the bytes of each input of the policy."""

    layout: Layout
    tensors: Sequence[bytes]
    accepts_compressed: bool


class PlainInfer:
    """POST /v2/models/{model}/infer with binary tensors."""

    api = API

    def __init__(self, inference: Inference) -> None:
        self._inference = inference
        self._max_batch = inference.serving.settings.max_batch
        self._layouts: WeakKeyDictionary[LoadedPolicy, dict[bytes, Layout]] = WeakKeyDictionary()

    def parse(
        self, target: Target, headers: Headers, body: bytes, policy: LoadedPolicy
    ) -> tuple[BinaryTensors, int] | None:
        """See `PlainFormat`."""
        length, accepted = framing(headers)
        if length is None or length > len(body):
            return None
        layout = self._layout(target, body, length, policy)
        if layout is None or len(body) != layout.size:
            return None
        return BinaryTensors(layout, [body[part] for part in layout.tensors], bool(accepted)), layout.rows

    def _layout(self, target: Target, body: bytes, length: int, policy: LoadedPolicy) -> Layout | None:
        """The layout of a request; None if an input is JSON. Raises LeagueError."""
        layouts = self._layouts.get(policy)
        if layouts is None:
            layouts = self._layouts[policy] = {}
        head = body[:length]
        layout = layouts.get(head)
        if layout is None:
            layout = self._parse(target, body, length, policy)
            if layout is not None and length <= MAX_HEAD:
                if len(layouts) == MAX_HEADS:
                    layouts.clear()
                layouts[head] = layout
        return layout

    def _parse(self, target: Target, body: bytes, length: int, policy: LoadedPolicy) -> Layout | None:
        request = read_request(target.model, target.version, body, length)
        outputs = wanted_outputs(request.infer.outputs, policy)
        arrays = read_inputs(request.infer.inputs, policy, self._max_batch)
        places, end = {}, length
        for tensor in request.infer.inputs:
            if not isinstance(tensor.data, memoryview):
                return None
            places[tensor.name] = slice(end, end := end + len(tensor.data))
        request = request._replace(infer=request.infer._replace(inputs=()))  # which refer to the body
        rows = len(next(iter(arrays.values())))
        return Layout(request, outputs, [places[port.name] for port in policy.observed], len(body), rows)

    def read(self, policy: LoadedPolicy, contents: Sequence[BinaryTensors], rows: int) -> Arrays:
        """See `PlainFormat`."""
        if len(contents) == 1:
            return observations_of(policy, contents[0].tensors, rows)
        tensors = map(b"".join, zip(*(content.tensors for content in contents), strict=True))
        return observations_of(policy, tensors, rows)

    def options(self, contents: Sequence[BinaryTensors]) -> ActionOptions:
        """See `PlainFormat`."""
        return options_for(chain.from_iterable(content.layout.outputs for content in contents))

    def write(self, request: PlainRequest, output: Actions, rows: slice) -> tuple[bytes, bytes] | None:
        """See `PlainFormat`."""
        content: BinaryTensors = request.content
        outputs = {name: output_of(name, output)[rows] for name in content.layout.outputs}
        response = InferResponse(
            request.target.model, str(request.policy.number), content.layout.request.infer.id, outputs
        )
        body, length = write_response(response, content.layout.request)
        if content.accepts_compressed and len(body) >= MIN_COMPRESSED_BYTES:
            return None
        lines = [b"content-type: %b\r\n" % (JSON if length is None else BINARY)]
        if length is not None:
            lines.append(b"%b: %d\r\n" % (HEADER_LENGTH, length))
        if content.accepts_compressed:
            lines.append(b"vary: accept-encoding\r\n")
        lines.append(b"content-length: %d\r\n" % len(body))
        return b"".join(lines), body

    def count(self, request: PlainRequest, times: Times, is_first: bool) -> None:
        """See `PlainFormat`."""
        entry = self._inference.statistics.entry(request.policy.model, request.policy.number)
        entry.succeed(request.rows, request.time, *times, perf_counter_ns(), int(is_first))
