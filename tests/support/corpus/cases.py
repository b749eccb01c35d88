"""Cases of the corpus: requests that are drawn by interface and number, many of them with a flaw or at a limit.

What only exists when a replica runs stands in a request as a placeholder: `<key:NAME>` for the text of an API key, and
`<state:MODEL:VERSION:NUMBER>` for a state token.
"""

import gzip
import json
import random
import re
import struct
import zlib
from base64 import b64encode
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from itertools import count
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray
from PIL import Image

from league.policies.open_inference import DATATYPES
from league.spaces import ACTION_MASK, Box, Discrete, Leaf, inputs, paths
from serve_app.codecs.request_limits import LARGE_BODY
from serve_app.inference.stream_codec import EXPLORE, GREEDY, HAS_SEED, encode_request
from serve_app.inference_protocol import open_inference_pb2 as messages
from serve_app.inference_protocol.field_count import MAX_FIELDS
from serve_app.inference_protocol.grpc_service import CONTENTS, FEW_TENSORS
from tests.support.clients.actions import INVALID
from tests.support.corpus.leagues import MODELS, SEARCHED
from tests.support.servers.replicas import READ_ONLY

Random = random.Random
PLACEHOLDER = re.compile(rb"<(key|state):([^<>]+)>")
SMALL = ("board", "board.shared", "duo.left", "duo.right", "vector", "nested", "choice", "kinds")
"""Models with small observations and one version."""
SPLIT = ("canaried", "shadowed", "mixed")
LARGE = ("chess", "pistons")
RECURRENT = ("memory", "memories")
NOBODY = ("empty", "headless", "nobody", "duo", "board.nobody", "a.b.c", "Board", "b%20d", "x" * 100)
"""Models that nobody answers for."""
ROWS = (1, 1, 1, 2, 3, READ_ONLY.max_batch, READ_ONLY.max_batch + 1)
KEYS = ("good",) * 8 + ("fast", "fast", "reader", "duo", "spent", "revoked", "expired", "unknown", "short")
VALUES = ("null", "true", "-1", "0.5", "2", "1e39", "12345678901234567890", '"1"', "[1]", "{}", "[]", "1.0")
"""JSON that may stand in the place of another value."""


@dataclass(frozen=True)
class HttpCase:
    """A request over HTTP. is_chunked: it has no Content-Length."""

    has_keys: bool
    """Whether the replica has API keys."""
    method: str
    target: str
    headers: tuple[tuple[str, str], ...]
    body: bytes
    is_chunked: bool = False


@dataclass(frozen=True)
class CallCase:
    """A call of ModelInfer."""

    has_keys: bool
    metadata: tuple[tuple[str, str], ...]
    body: bytes


@dataclass(frozen=True)
class StreamCase:
    """A stream, and its messages. Texts are not always UTF-8."""

    has_keys: bool
    target: str
    headers: tuple[tuple[str, str], ...]
    messages: tuple[tuple[bytes, bool], ...]
    """(message, whether it is a text)"""


Case = HttpCase | CallCase | StreamCase


def cases(interface: str, number: int) -> Iterator[Case]:
    """The cases of an interface that have `number` requests, or messages, together."""
    draw, size = INTERFACES[interface], 0
    for index in count():
        case = draw(Random(f"{interface} {index}"))
        yield case
        size += len(case.messages) if isinstance(case, StreamCase) else 1
        if size >= number:
            return


def observations(random: Random, model: str, rows: int) -> dict[str, NDArray]:
    """Valid observations: the inputs of the graph, without state."""
    if model == SEARCHED:
        mask = _integers(random, (rows, 9), "int8", 2)
        mask[:, 4] = 1
        return {"observation": np.zeros((rows, 3, 3, 2), np.int8), ACTION_MASK: mask}
    return {name: _drawn(random, name, leaf, rows) for name, leaf in inputs(MODELS[model].observation).items()}


def _drawn(random: Random, name: str, leaf: Leaf, rows: int) -> NDArray:
    shape = (rows, *leaf.shape)
    if isinstance(leaf, Discrete):
        return _integers(random, shape, leaf.dtype, leaf.n) + leaf.start
    assert isinstance(leaf, Box)
    if np.dtype(leaf.dtype).kind == "f":
        return (_integers(random, shape, "int64", 201) / 100 - 1).astype(leaf.dtype)
    array = _integers(random, shape, leaf.dtype, 2 if leaf.high in (1, True) or leaf.dtype == "bool" else 100)
    if name == ACTION_MASK:
        array[..., 3] = 1
    return array


def _integers(random: Random, shape: tuple[int, ...], dtype: str, end: int) -> NDArray:
    numbers = np.frombuffer(random.randbytes(int(np.prod(shape))), np.uint8) % end
    return numbers.reshape(shape).astype(dtype)


def _nested(model: str, arrays: Mapping[str, NDArray], row: int, encode: Callable[[NDArray], Any]) -> Any:
    """One observation in JSON."""
    document: dict[str, Any] = {}
    places = {name: (name,) for name in arrays} if model == SEARCHED else paths(MODELS[model].observation)
    for name, array in arrays.items():
        *outer, last = ("", *places[name])
        inner = document
        for key in outer:
            inner = inner.setdefault(key, {})
        inner[last] = encode(array[row])
    return document[""]


def _list(array: NDArray) -> Any:
    return array.tolist()


def _base64(array: NDArray) -> Any:
    return {"b64": b64encode(array.tobytes()).decode()}


def _described(array: NDArray) -> Any:
    return _base64(array) | {"dtype": array.dtype.name, "shape": list(array.shape)}


def _png(array: NDArray) -> Any:
    if array.dtype != np.uint8 or array.ndim != 3:
        return _base64(array)
    picture = BytesIO()
    Image.fromarray(array, "RGBA").save(picture, "png")
    return {"png": b64encode(picture.getvalue()).decode()}


def _model(random: Random) -> str:
    kind = random.random()
    for share, names in ((0.6, SMALL), (0.75, SPLIT), (0.82, LARGE), (0.92, RECURRENT), (0.95, ("sampled",))):
        if kind < share:
            return random.choice(names)
    return random.choice((*NOBODY, SEARCHED))


def _document(random: Random, model: str) -> dict[str, Any]:
    """A request for actions, mostly valid."""
    template = model if model in MODELS or model == SEARCHED else "board"
    rows = random.choice(ROWS)
    encode = random.choice([_png, _png, _base64] if template == "pistons" else [_list] * 8 + [_base64, _described])
    arrays = observations(random, template, rows)
    batch = [_nested(template, arrays, row, encode) for row in range(rows)]
    is_batch = rows > 1 or random.random() < 0.3
    document: dict[str, Any] = {"observations": batch} if is_batch else {"observation": batch[0]}
    if model == "sampled" or random.random() < 0.2:
        document |= random.choice([{"explore": False}, {"explore": True, "seed": random.randrange(99)}])
        if is_batch and random.random() < 0.3:
            document["seed"] = [random.randrange(99) for _ in range(rows + random.choice([0, 0, 0, 1]))]
    if random.random() < 0.2:
        document["probabilities"] = random.choice([True, True, False, 1])
    if model in RECURRENT:
        document |= _state(random, rows, is_batch)
    if model == SEARCHED:
        document |= random.choice([{}, {"deadline_ms": 86_400_000}, {"analysis": True}, {"deadline_ms": 0}])
    elif random.random() < 0.04:
        document |= random.choice(
            [{"deadline_ms": 1000}, {"deadline_ms": 1.5}, {"analysis": True}, {"seed": -1}, {"state": None}]
        )
    return document


def _state(random: Random, rows: int, is_batch: bool) -> dict[str, Any]:
    if random.random() < 0.2:
        numbers = [[random.randrange(5)] for _ in range(rows)]
        return {"state": random.choice([{}, {"state_in_0": numbers}, {"state_in_0": [numbers]}, {"state_in_1": 1}])}
    version = random.choice([1, 1, 1, 2])
    tokens = [
        random.choice([None, f"<state:memory.shared:{version}:{random.randrange(5)}>"] * 4 + [_token(random)])
        for _ in range(rows)
    ]
    return {"state": random.choice([tokens] * 8 + [tokens[:-1], tokens[0]]) if is_batch else tokens[0]}


def _token(random: Random) -> Any:
    return random.choice(
        ["", "AAAA", 3, "<state:memories.shared:1:2>", "<state:board.shared:1:1>", "<state:memory.shared:2:1>"]
    )


def _json(random: Random, document: Any) -> bytes:
    """The text of a document, often with a flaw, but not one because of which actions would be random."""
    content = orjson.dumps(document) if random.random() < 0.5 else json.dumps(document).encode()
    text = _flawed(random, content)
    with suppress(ValueError):
        parsed = orjson.loads(text)
        if isinstance(parsed, dict) and b'"explore"' in content and parsed.get("seed") is None:
            return content
    return text


def _flawed(random: Random, content: bytes) -> bytes:
    match random.randrange(24):
        case 0:
            return _mutated(random, content)
        case 1:
            return content[: random.randrange(len(content))]
        case 2:
            numbers = list(re.finditer(rb"(?<=[\[:, ])[0-9.]+(?=[\],} ])", content))
            if numbers:
                place, value = random.choice(numbers), random.choice(VALUES).encode()
                return content[: place.start()] + value + content[place.end() :]
        case 3:
            old, new = random.choice(
                [(b"action_mask", b"mask"), (b'"observation', b'"obs'), (b"[1", b"[["), (b"1]", b"1")]
            )
            return content.replace(old, new, 1)
        case 4:
            more = random.choice(
                ['"exlpore": true', '"a\\u0062c": [1]', '"observation": 1', '"seed": 3', '"state": []']
            )
            return content.replace(b"{", b"{%b, " % more.encode(), 1)
        case 5:
            return content.replace(
                b'"observation', random.choice([b'"\\u006fbservation', b'"observation" :\t{"observation']), 1
            )
        case 6:
            return _padded(random, content)
        case 7:
            return content.replace(b"[1", random.choice([b"[0", b"[true", b"[1.0", b"[2", b"[-1", b"[1e0"]))
        case 8:
            _, invalid, *_ = INVALID[random.choice(sorted(INVALID))]
            return invalid if isinstance(invalid, bytes) else json.dumps(invalid).encode()
    return content


def _mutated(random: Random, content: bytes) -> bytes:
    place = random.randrange(len(content))
    return content[:place] + random.randbytes(1) + content[place + 1 :]


def _padded(random: Random, content: bytes) -> bytes:
    """A document whose size is at a limit or beyond it, or one with more brackets or commas than any valid one."""
    limit = random.choice([LARGE_BODY, LARGE_BODY, READ_ONLY.max_body])
    filler = random.choice([b" ", b" ", b"[", b",", b"1,"])
    size = max(limit + random.choice([-1, 0, 1]) - len(content) - len(b',"more":[]'), 0) // len(filler)
    if filler == b" ":
        return content[:-1] + filler * (limit + random.choice([-1, 0, 1]) - len(content)) + content[-1:]
    return content[:-1] + b',"more":[' + filler * size + b"]" + content[-1:]


def _headers(random: Random, has_keys: bool) -> list[tuple[str, str]]:
    """Headers of a request that are not about its body."""
    headers = [("Host", "localhost")]
    if has_keys and random.random() < 0.95:
        key = f"<key:{random.choice(KEYS)}>"
        headers.append(
            random.choice([("Authorization", f"Bearer {key}"), ("X-API-Key", key), ("authorization", f"bearer {key}")])
        )
    match random.randrange(20):
        case 0:
            headers.append(("Origin", random.choice(["http://localhost", "http://example.org", "null"])))
        case 1:
            headers[0] = ("Host", random.choice(["127.0.0.1:8000", "example.org", "[::1]", "localhost:1"]))
        case 2:
            headers.append(("X-Request-Timeout-Ms", random.choice(["90000", "soon", "0", "-1", "1" * 10])))
        case 3:
            headers.append(("Sec-Fetch-Site", random.choice(["same-origin", "cross-site", "none"])))
        case 4:
            headers.append(("Accept", "*/*"))
    if random.random() < 0.3:
        headers.append(("X-League-Key", random.choice("abcdefgh")))
    return headers


def _caller(random: Random, model: str, headers: list[tuple[str, str]]) -> None:
    """Without a key, the member of a mixture is random."""
    if model in ("mixed", "memories") and all(name != "X-League-Key" for name, _ in headers):
        headers.append(("X-League-Key", random.choice("abcdefgh")))


def _http(
    random: Random, has_keys: bool, target: str, headers: list[tuple[str, str]], body: bytes, type_name: str
) -> HttpCase:
    method = "POST"
    match random.randrange(24):
        case 0:
            type_name = random.choice(
                ["application/json; charset=utf-8", "text/plain", "application/xml", "application/x+json", ""]
            )
        case 1:
            body, encoding = random.choice(
                [
                    (gzip.compress(body, mtime=0), "gzip"),
                    (zlib.compress(body), "deflate"),
                    (gzip.compress(body, mtime=0)[:-3], "x-gzip"),
                    (gzip.compress(bytes(READ_ONLY.max_body + 1), mtime=0), "gzip"),
                    (body, "gzip"),
                    (body, "br"),
                    (body, "identity"),
                ]
            )
            headers.append(("Content-Encoding", encoding))
        case 2:
            method = random.choice(["GET", "PUT", "DELETE", "OPTIONS"])
        case 3:
            target = random.choice(
                [target + "/", target.replace("v1", "v3"), target.replace("o", "%6f"), target + "?a=b&version="]
            )
    if type_name:
        headers.append(("Content-Type", type_name))
    return HttpCase(has_keys, method, target, tuple(headers), body, is_chunked=random.random() < 0.05)


def action(random: Random) -> HttpCase:
    """A request of POST /v1/policies/{model}/action."""
    has_keys, model = random.random() < 0.3, _model(random)
    headers, version = _headers(random, has_keys), ""
    _caller(random, model, headers)
    if model == SEARCHED:
        version = "?version=2"
    elif random.random() < 0.15:
        version = random.choice(["1", "2", "3", "9", "champion", "nobody", "-1", "1.5", "", "0", "9" * 30, "a b"])
        version = f"?version={version}".replace(" ", "%20")
    body = _json(random, _document(random, model))
    return _http(random, has_keys, f"/v1/policies/{model}/action{version}", headers, body, "application/json")


def infer(random: Random) -> HttpCase:
    """A request of POST /v2/models/{model}/infer."""
    has_keys, model = random.random() < 0.3, _model(random)
    headers = _headers(random, has_keys)
    _caller(random, model, headers)
    document, tensors = _infer_document(random, model)
    head = _json(random, document) if random.random() < 0.5 else orjson.dumps(document)
    type_name = "application/json"
    if tensors or random.random() < 0.02:
        data = b"".join(tensors)
        match random.randrange(30):
            case 0:
                data = _mutated(random, data or b"0")
            case 1:
                data = data[:-1]
            case 2:
                data += b"\0"
        length = random.choice([str(len(head))] * 20 + ["0", str(len(head) + 1), "9" * 10, "9" * 11, "soon", ""])
        headers.append(("Inference-Header-Content-Length", length))
        head, type_name = head + data, "application/octet-stream"
    if random.random() < 0.2:
        headers.append(("Accept-Encoding", random.choice(["gzip", "deflate, gzip", "gzip;q=0", "br", "*"])))
    version = ""
    if model == SEARCHED:
        version = "/versions/2"
    elif random.random() < 0.15:
        version = random.choice(
            ["/versions/1", "/versions/2", "/versions/champion", "/versions/9", "/versions/", "/versions/-1"]
        )
    return _http(random, has_keys, f"/v2/models/{model}{version}/infer", headers, head, type_name)


def _tensors(random: Random, model: str) -> dict[str, NDArray]:
    arrays = observations(random, model if model in MODELS or model == SEARCHED else "board", random.choice(ROWS))
    rows = len(next(iter(arrays.values())))
    if model in RECURRENT and random.random() < 0.6:
        arrays["state_in_0"] = _integers(random, (rows, 1), "float32", 5)
    match random.randrange(40):
        case 0:
            del arrays[random.choice(list(arrays))]
        case 1:
            name = random.choice(list(arrays))
            arrays[name] = arrays[name][:-1]
        case 2:
            name = random.choice(list(arrays))
            arrays[name] = random.choice([arrays[name].astype("float64"), arrays[name][..., None], arrays[name] * 0])
        case 3:
            arrays[random.choice(["more", "value", "state_in_0"])] = np.ones((rows, 1), np.float32)
    items = list(arrays.items())
    random.shuffle(items)
    return dict(items)


def _outputs(random: Random, model: str) -> list[str]:
    outputs = ["action"] * random.randint(0, 1)
    if random.random() < 0.3:
        outputs.append(random.choice(["action_dist_inputs"] * 8 + ["state_out_0", "answer", "action"]))
    return outputs


def _infer_document(random: Random, model: str) -> tuple[dict[str, Any], list[bytes]]:
    """The JSON of a request, and its binary tensors."""
    described, tensors = [], list[bytes]()
    is_binary = random.random() < 0.5
    for name, array in _tensors(random, model).items():
        tensor: dict[str, Any] = {"name": name, "datatype": DATATYPES[array.dtype.name], "shape": list(array.shape)}
        if is_binary != (random.random() < 0.03):
            tensors.append(array.tobytes())
            tensor["parameters"] = {"binary_data_size": len(tensors[-1])}
        else:
            tensor["data"] = random.choice([array, array.ravel()]).tolist()
        if random.random() < 0.03:
            tensor |= random.choice(
                [
                    {"datatype": "BYTES"},
                    {"datatype": None},
                    {"shape": [1]},
                    {"shape": "1"},
                    {"shape": [-1, *array.shape[1:]]},
                    {"name": 1},
                    {"parameters": {"shared_memory_region": "a"}},
                    {"parameters": 1},
                    {"data": "1"},
                    {"data": []},
                ]
            )
        described.append(tensor)
    document: dict[str, Any] = {"inputs": described}
    if outputs := _outputs(random, model):
        document["outputs"] = [{"name": name} for name in outputs]
        for output in document["outputs"]:
            if random.random() < 0.5:
                output["parameters"] = random.choice(
                    [{"binary_data": True}, {"binary_data": False}] * 4 + [{"classification": 3}, {"binary_data": 1}]
                )
    if random.random() < 0.3:
        document["id"] = random.choice(["a", "b", "", None, 3, "\u00e9" * 9])
    if random.random() < 0.3:
        document["parameters"] = random.choice(
            [{"binary_data_output": True}, {"binary_data_output": None}, {"sequence_id": 1}, {"a": 1}] * 4
            + [[], {"binary_data_output": "yes"}]
        )
    return document, tensors


def call(random: Random) -> CallCase:
    """A call of inference.GRPCInferenceService/ModelInfer."""
    has_keys, model = random.random() < 0.3, _model(random).replace("%20", " ")
    headers = [pair for pair in _headers(random, has_keys) if pair[0] in ("Authorization", "X-API-Key", "X-League-Key")]
    _caller(random, model, headers)
    version = "2" if model == SEARCHED else random.choice([""] * 9 + ["1", "2", "champion", "9", "a b"])
    request = messages.ModelInferRequest(
        model_name=model, model_version=version, id=random.choice(["", "", "a", "\u00e9"])
    )
    is_raw = random.random() < 0.7
    for name, array in _tensors(random, model).items():
        tensor = request.inputs.add(name=name, datatype=DATATYPES[array.dtype.name], shape=array.shape)
        field = CONTENTS.get(tensor.datatype)
        if is_raw or field is None:
            request.raw_input_contents.append(array.tobytes())
        else:
            getattr(tensor.contents, field).extend(array.ravel().tolist())
        if random.random() < 0.03:
            _spoil(random, tensor)
    for name in _outputs(random, model):
        request.outputs.add(name=name)
    _extend(random, request)
    body = request.SerializeToString(deterministic=True)
    match random.randrange(20):
        case 0:
            body = _mutated(random, body)
        case 1:
            body = body[: random.randrange(len(body))]
    return CallCase(has_keys, tuple((name.lower(), value) for name, value in headers), body)


def _spoil(random: Random, tensor: messages.ModelInferRequest.InferInputTensor) -> None:
    match random.randrange(5):
        case 0:
            tensor.datatype = random.choice(["BYTES", "", "FP16", "INT64"])
        case 1:
            tensor.shape.append(1)
        case 2:
            tensor.parameters["shared_memory_region"].string_param = "a"
        case 3:
            tensor.contents.int_contents.append(1)
        case 4:
            del tensor.shape[:]


def _extend(random: Random, request: messages.ModelInferRequest) -> None:
    match random.randrange(20):
        case 0:
            request.parameters["sequence_id"].int64_param = random.randrange(2)
        case 1:
            for _ in range(random.choice([FEW_TENSORS, FEW_TENSORS + 1])):
                request.outputs.add(name="action")
        case 2:
            for _ in range(MAX_FIELDS // 2 + random.randrange(-2, 3)):
                request.outputs.add()
        case 3:
            request.raw_input_contents.append(bytes(random.choice([0, READ_ONLY.max_body, LARGE_BODY])))


def text_stream(random: Random) -> StreamCase:
    """A stream of JSON messages."""
    return _stream(random, _text_message)


def binary_stream(random: Random) -> StreamCase:
    """A stream of binary messages, and a few of JSON."""
    return _stream(
        random, lambda random, model: (_binary_message if random.random() < 0.9 else _text_message)(random, model)
    )


def _stream(random: Random, message: Callable[[Random, str], tuple[bytes, bool]]) -> StreamCase:
    has_keys, model = random.random() < 0.2, _model(random)
    headers = [pair for pair in _headers(random, has_keys) if pair[0] != "Accept"]
    _caller(random, model, headers)
    query = random.choice(
        [""] * 6
        + [
            "?version=1",
            "?version=2",
            "?version=9",
            "?follow=champion",
            "?follow=champion",
            "?follow=nobody",
            "?follow=champion&version=1",
            "?follow=1",
        ]
    )
    if model == SEARCHED:
        query = "?version=2"
    # Without a reset, the episodes of a message are those of the last one, so most have the same number of rows.
    return StreamCase(
        has_keys,
        f"/v1/policies/{model}/stream{query}",
        tuple(headers[1:]),
        tuple(message(random, model) for _ in range(random.choice([1, 3, 6, 10]))),
    )


def _text_message(random: Random, model: str) -> tuple[bytes, bool]:
    document = _document(random, model)
    if random.random() < 0.3:
        document |= random.choice(
            [{"reset": True}, {"reset": False}, {"return_state": True}, {"reset": [True]}, {"reset": [True, False]}]
        )
    if random.random() < 0.03:
        document = {"reset": True}
    content = _json(random, document)
    if random.random() < 0.01:
        content = b'"\xff"'
    return content, True


def _binary_message(random: Random, model: str) -> tuple[bytes, bool]:
    template = model if model in MODELS or model == SEARCHED else "board"
    rows = random.choice(ROWS)
    arrays = observations(random, template, rows)
    tensors = [array.astype(array.dtype.newbyteorder("<")) for array in arrays.values()]
    explore = random.choice([None, None, False, True])
    if model == "sampled":
        explore = random.choice([False, True])
    seed = random.randrange(99) if explore else random.choice([None, None, None, 3])
    whole = content = encode_request(tensors, rows, seed, explore, reset=random.random() < 0.3)
    match random.randrange(16):
        case 0:
            content = _mutated(random, content)
        case 1:
            content = content[: random.randrange(len(content))]
        case 2:
            content += b"\0"
        case 3:
            head = random.choice(
                [
                    (1, 64, 0, rows, 0),
                    (2, 0, 0, rows, 0),
                    (1, 0, 1, rows, 0),
                    (1, 17, 0, rows, 0),
                    (1, 0, 0, 0, 0),
                    (1, 2, 0, rows, 2**63),
                    (1, 0, 0, rows, 5),
                ]
            )
            content = struct.pack("<BBHIQ", *head) + content[16:]
        case 4:
            resets = bytes(random.choice([0, 1]) for _ in range(rows)) if random.random() < 0.8 else b"\2" * rows
            content = bytes((1, content[1] | 8)) + content[2:16] + resets + content[16:]
        case 5 if model in ("board", "vector"):
            content = content[:16] + bytes(random.choice([0, 255]) for _ in range(len(content) - 16))
    is_random = len(content) > 1 and not content[1] & HAS_SEED and (content[1] & EXPLORE or model == "sampled")
    return whole if is_random and not whole[1] & GREEDY else content, False


INTERFACES: dict[str, Callable[[Random], Case]] = {
    "action": action,
    "infer": infer,
    "grpc": call,
    "stream, JSON": text_stream,
    "stream, binary": binary_stream,
}
