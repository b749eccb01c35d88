"""Sends the cases of the corpus to replicas, and writes their answers in a form that is the same in each run.

Normalised are: digests of versions (`sha256 of LEAGUE@NUMBER`), state tokens (model, version, numbers), the order of
the keys of objects and of headers, floats (six digits), the encoding of a body (gzip, binary tensors), the header
`date`, and `retry-after` of a key whose rate is exceeded. `content-length` is compared with the body instead.
"""

import asyncio
import gzip
import hashlib
import json
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from math import isclose
from typing import Any

import grpc
import numpy as np
import pytest
from google.protobuf.json_format import MessageToDict
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from league.errors import InvalidState
from league.policies.open_inference import DATATYPES
from league.registry.registry import Registry
from league.settings import Storage
from serve_app.codecs.state_tokens import read_token, write_tokens
from serve_app.inference.stream_codec import RESPONSE
from serve_app.inference_protocol import grpc_handlers
from serve_app.inference_protocol import open_inference_pb2 as messages
from serve_app.runtime import uvicorn_websocket
from tests.support.corpus.cases import INTERFACES, PLACEHOLDER, CallCase, Case, HttpCase, StreamCase, cases
from tests.support.corpus.leagues import build, create_keys
from tests.support.servers.local_search import searching_server
from tests.support.servers.replicas import READ_ONLY
from tests.support.servers.two_paths import Connections, exchange, together
from tests.support.templates import copy_of
from tests.support.waiting import until

TOGETHER = (1, 2, 7)
"""Numbers of requests over HTTP that arrive in one turn of the event loop, in turn."""
METHOD = "/inference.GRPCInferenceService/ModelInfer"
NUMBERS = {datatype: np.dtype(name).newbyteorder("<") for name, datatype in DATATYPES.items()}
IGNORED = ("date", "content-length", "content-encoding")
TIMEOUT = 120.0
Answer = Any
"""A JSON document."""


@dataclass
class Side:
    """A replica, the digests of its versions, and the API keys that its registry has."""

    connections: Connections
    registry: Registry
    keys: Mapping[str, str]
    names: Mapping[str, str]
    call: Any = None
    """A function that sends a message to ModelInfer."""

    def rendered(self, data: bytes) -> bytes:
        """Data with what its placeholders stand for."""
        return PLACEHOLDER.sub(lambda match: self._value(match[1], match[2].decode()), data)

    def _value(self, kind: bytes, name: str) -> bytes:
        if kind == b"key":
            return self.keys[name].encode()
        model, version, number = name.split(":")
        sha256 = self.registry.versions.get(model.partition(".")[0], int(version)).sha256
        (token,) = write_tokens(model, int(version), sha256, {"state_in_0": np.array([[number]], np.float32)})
        return token.encode()

    def normal(self, document: Any) -> Answer:
        """A document in the form in which it is stored."""
        match document:
            case dict():
                return {key: self.normal(value) for key, value in document.items()}
            case list():
                return [self.normal(value) for value in document]
            case float():
                return float(f"{document:.6g}")
            case str():
                return self.names.get(document) or _token(document)
        return document


def _token(text: str) -> Answer:
    try:
        model, version, _, state = read_token(text)
    except InvalidState:
        return text
    return {"token": model, "version": version, "numbers": np.frombuffer(state, "<f4").tolist()}


@contextmanager
def sides(storages: Sequence[Storage]) -> Iterator[dict[bool, Side]]:
    """Replicas with the leagues of the corpus, without API keys and with some, in two empty homes."""
    uvicorn_websocket.install(READ_ONLY.max_body, READ_ONLY.max_incomplete)
    with ExitStack() as stack:
        monkeypatch = stack.enter_context(pytest.MonkeyPatch.context())
        monkeypatch.setattr(grpc_handlers, "_service", None)  # of this process: restored at the end
        yield {
            has_keys: stack.enter_context(_side(storage, has_keys, monkeypatch))
            for has_keys, storage in zip((False, True), storages, strict=True)
        }


@contextmanager
def _side(storage: Storage, has_keys: bool, monkeypatch: pytest.MonkeyPatch) -> Iterator[Side]:
    registry = copy_of(build, storage)
    names = {
        version.sha256: f"sha256 of {league}@{version.number}"
        for league in registry.leagues.names()
        for version in registry.versions.all(league)
    }
    keys = create_keys(registry) if has_keys else {}
    # A busy machine may measure that policies are too slow for the event loop.
    server, _ = searching_server(registry, monkeypatch, READ_ONLY.model_copy(update={"inline": 10.0}))
    with Connections(server) as connections, _calls(connections) as call:
        until(lambda: server.watcher.is_ready)
        side = Side(connections, registry, keys, names, call)
        if has_keys:
            spend = HttpCase(True, "POST", "/v1/policies/board/action", (("X-API-Key", "<key:spent>"),), b"{}")
            _exchange(side, connections.general, [_http_request(side, spend)])
        yield side
    registry.close()


@contextmanager
def _calls(connections: Connections) -> Iterator[Any]:
    """A function that sends a message to ModelInfer of a replica."""

    async def start() -> tuple[grpc.aio.Server, int]:
        server = grpc.aio.server()
        grpc_handlers.add_service(None, server)
        port = server.add_insecure_port("127.0.0.1:0")
        await server.start()
        return server, port

    server, port = asyncio.run_coroutine_threadsafe(start(), connections.loop).result()
    with grpc.insecure_channel(f"127.0.0.1:{port}") as channel:
        yield channel.unary_unary(METHOD, response_deserializer=messages.ModelInferResponse.FromString)
    asyncio.run_coroutine_threadsafe(server.stop(None), connections.loop).result()


def digest(case: Case) -> str:
    """Identifies a case."""
    return hashlib.blake2b(repr(case).encode(), digest_size=4).hexdigest()


def rounds(sides: Mapping[bool, Side], numbers: Sequence[int]) -> Iterator[tuple[str, str, list[Answer]]]:
    """Send numbers of requests to each interface: (interface, digest of the case, its answers).

    After each number, what the replicas have counted: ("counts", number and side, its only answer). A request over HTTP
    has two answers: that of the fast path, and that of the application.
    """
    done = dict.fromkeys(INTERFACES, 0)
    for number in numbers:
        for interface in INTERFACES:
            former, done[interface] = done[interface], len(drawn := list(cases(interface, number)))
            for has_keys, side in sides.items():
                grpc_handlers.install(side.connections.server.inference_service)
                side_cases = [case for case in drawn[former:] if case.has_keys == has_keys]
                for case, answers in zip(side_cases, _answers(side, side_cases), strict=True):
                    yield interface, digest(case), answers
        for has_keys, side in sides.items():
            yield "counts", f"{number} {'with' if has_keys else 'without'} keys", [counts(side)]


def _answers(side: Side, side_cases: Sequence[Case]) -> Iterator[list[Answer]]:
    at = 0
    while at < len(side_cases):
        group = side_cases[at : at + TOGETHER[at % len(TOGETHER)]]
        at += len(group)
        if isinstance(group[0], HttpCase):
            requests = [_http_request(side, case) for case in group if isinstance(case, HttpCase)]
            addresses = (side.connections.fast, side.connections.general)
            yield from map(list, zip(*(_exchange(side, address, requests) for address in addresses), strict=True))
        else:
            for case in group:
                yield [_called(side, case) if isinstance(case, CallCase) else _streamed(side, case)]


def _http_request(side: Side, case: HttpCase) -> bytes:
    body = side.rendered(case.body)
    lines = [f"{case.method} {case.target} HTTP/1.1", *(f"{name}: {value}" for name, value in case.headers)]
    lines.append("Transfer-Encoding: chunked" if case.is_chunked else f"Content-Length: {len(body)}")
    if case.is_chunked:
        parts = [body[at : at + 4096] for at in range(0, len(body), 4096)]
        body = b"".join(b"%x\r\n%b\r\n" % (len(part), part) for part in [*parts, b""])
    return side.rendered("\r\n".join([*lines, "", ""]).encode()) + body


def _exchange(side: Side, address: tuple[str, int], requests: list[bytes]) -> list[Answer]:
    responses = together(side.connections, address, requests) if len(requests) > 1 else [exchange(address, requests[0])]
    return [_http_answer(side, response) for response in responses]


def _http_answer(side: Side, response: bytes) -> Answer:
    head, _, body = response.partition(b"\r\n\r\n")
    line, *lines = head.decode("latin-1").split("\r\n")
    headers = {name.lower(): value for name, _, value in (line.partition(": ") for line in lines)}
    assert len(headers) == len(lines), f"a header is repeated: {lines}"
    return _answer(side, int(line.split()[1]), headers, body)


def _answer(side: Side, status: int, headers: dict[str, str], body: bytes) -> Answer:
    assert int(headers["content-length"]) == len(body)
    if encoding := headers.get("content-encoding"):
        body = gzip.decompress(body) if encoding == "gzip" else zlib.decompress(body)
    if headers.get("retry-after", "").isdigit() and int(headers["retry-after"]) > 100:
        headers["retry-after"] = "long"
    length = headers.pop("inference-header-content-length", None)
    document, tensors = json.loads(body[: int(length)] if length else body or "null"), {}
    if length:
        at = int(length)
        for output in document["outputs"]:
            if size := output.get("parameters", {}).get("binary_data_size"):
                tensors[output["name"]] = np.frombuffer(body[at : at + size], NUMBERS[output["datatype"]]).tolist()
                at += size
        assert at == len(body)
    kept = {name: value for name, value in headers.items() if name not in IGNORED}
    return side.normal({"status": status, "headers": kept, "body": document} | ({"tensors": tensors} if length else {}))


def _called(side: Side, case: CallCase) -> Answer:
    metadata = [(name, side.rendered(value.encode()).decode()) for name, value in case.metadata]
    try:
        response = side.call(case.body, metadata=metadata, timeout=TIMEOUT)
    except grpc.RpcError as error:
        return {"code": error.code().name, "details": error.details()}
    document = MessageToDict(response, preserving_proto_field_name=True)
    del document["raw_output_contents"]
    contents = zip(response.outputs, response.raw_output_contents, strict=True)
    tensors = {output.name: np.frombuffer(data, NUMBERS[output.datatype]).tolist() for output, data in contents}
    return side.normal({"message": document, "tensors": tensors})


def _streamed(side: Side, case: StreamCase) -> Answer:
    host, port = side.connections.fast
    headers = [(name, side.rendered(value.encode()).decode()) for name, value in case.headers]
    try:
        stream = connect(
            f"ws://{host}:{port}{case.target}",
            additional_headers=headers,
            compression=None,
            max_size=None,
            ping_interval=None,
            open_timeout=TIMEOUT,
        )
    except InvalidStatus as error:
        response = error.response
        refused = {name.lower(): value for name, value in response.headers.raw_items()}
        return _answer(side, response.status_code, refused, bytes(response.body))
    assert stream.response is not None
    kept = {name.lower(): value for name, value in stream.response.headers.raw_items() if name.startswith("x-")}
    replies = list[Answer]()
    with stream, suppress(ConnectionClosed):
        try:
            messages = [(side.rendered(message), is_text) for message, is_text in case.messages]
            # All at once, or one after the other.
            is_joint = len(messages) % 2 == 0 and all(_is_answered(*message) for message in messages)
            for message, is_text in messages:
                stream.send(message, text=is_text)
                if not is_joint:
                    replies.append(_reply(case, stream))
            while len(replies) < len(messages):
                replies.append(_reply(case, stream))
        except ConnectionClosed as closed:
            end = closed.rcvd
            replies.append(None if end is None else {"closed": end.code, "reason": end.reason})
    return side.normal({"headers": kept, "replies": replies})


def _is_answered(message: bytes, is_text: bool) -> bool:
    """Whether a stream stays open after a message."""
    with suppress(UnicodeDecodeError):
        return len(message) <= READ_ONLY.max_body and (not is_text or bool(message.decode()))
    return False


def _reply(case: StreamCase, stream: ClientConnection) -> Answer:
    reply = stream.recv(TIMEOUT)
    if isinstance(reply, str):
        return json.loads(reply)
    framing, flags, zero, rows, version, last = RESPONSE.unpack_from(reply)
    assert (framing, flags, zero, last) == (1, 0, 0, 0)
    size = (len(reply) - RESPONSE.size) // rows
    numbers = np.frombuffer(reply, "<i8" if size == 8 and "vector" not in case.target else "<f4", offset=RESPONSE.size)
    return {"version": version, "rows": rows, "actions": numbers.tolist()}


def counts(side: Side) -> Answer:
    """What a replica has counted: requests, observations and errors, and requests of canaries and shadows."""
    server = side.connections.server
    until(lambda: not server.shadow.waiting_bytes)

    async def report() -> dict[str, Any]:
        documents = server.inference.statistics.documents()
        kept = ("success", "fail")
        shadows = Counter[str]()
        for one in server.shadow.shadowings():
            shadows[f"{one.league} {one.candidate} {one.champion}"] = (
                one.requests + one.failed + one.dropped + one.skipped
            )
        return server.metrics.report() | {
            "statistics": [
                [one["name"], one["version"], one["inference_count"]]
                + [one["inference_stats"][name]["count"] for name in kept]
                for one in documents
            ],
            "mirrored": sorted(shadows.items()),
        }

    whole = asyncio.run_coroutine_threadsafe(report(), side.connections.loop).result()
    kept = (
        "league_batch_observations",
        "league_errors_total",
        "league_canary_requests_total",
        "statistics",
        "mirrored",
    )
    return {name: sorted(map(list, whole[name]), key=str) for name in kept}


def alike(one: Answer, other: Answer) -> bool:
    """Whether two answers are equal, floats nearly: processors differ in their last digits."""
    if type(one) is not type(other):
        return False
    match one:
        case dict():
            return one.keys() == other.keys() and all(alike(value, other[key]) for key, value in one.items())
        case list():
            return len(one) == len(other) and all(map(alike, one, other))
        case float():
            return isclose(one, other, rel_tol=1e-4, abs_tol=1e-5)
    return bool(one == other)
