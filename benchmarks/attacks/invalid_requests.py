"""10,000 invalid request bodies to one replica over loopback.

Four tenths are generated from the server's OpenAPI document by schemathesis, valid and invalid, for each route; four
tenths are valid requests with bytes changed, removed or inserted, for actions and inferences, in JSON and binary, plain
and compressed; two tenths are such messages of a stream.
"""

import gzip
import json
import zlib
from base64 import b64encode
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from random import Random
from typing import Any

import httpx
import requests
import schemathesis
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from schemathesis import GenerationMode
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from benchmarks.harness import Target
from benchmarks.leagues.served_league import ACTION, BODY, LEAGUE, PLANES
from benchmarks.processes import replica_processes
from serve_app.inference.stream_codec import encode_request as message_of

GROWTH = 5.0
"""Maximum growth of the replica's memory, in percent."""
ROUTES = ("/v1/policies/{model}/action", "/v2/models/{model}/infer")
INVALID_VALUES = [
    None,
    True,
    -1,
    2**63,
    1e308,
    "",
    "\x00",
    "🎲",
    [],
    {},
    [[]],
    {"b64": ""},
    {"png": ""},
    [None],
    {"": 0},
    "NaN",
]
Request = tuple[str, bytes, dict[str, str]]
"""Path, body, headers."""


def invalid_requests(url: str, home: Path, bodies: int, number: int = 0) -> Iterator[Target]:
    """Send all bodies to a server with one replica and two versions. home: its LEAGUE_HOME; number: seed."""
    with httpx.Client(base_url=url, timeout=30) as client:
        (replica,) = replica_processes(home)
        statuses: Counter[str] = Counter()
        _warm_up(client, statuses, bodies // 10, number)
        before = replica.memory_info().rss
        _from_document(client, statuses, bodies * 4 // 10, number)
        _changed(client, statuses, bodies - bodies // 10 - bodies * 4 // 10 - bodies * 2 // 10, number)
        _stream(url, statuses, bodies * 2 // 10, number)
        faults = sum(count for status, count in statuses.items() if status.startswith("5") or status == "dropped")
        note = ", ".join(f"{status} {count:,}" for status, count in sorted(statuses.items()))
        yield Target("5xx, and dropped connections", faults, at_most=0, note=note)
        after = replica.memory_info().rss
        note = f"{before / 2**20:.1f} to {after / 2**20:.1f} MB"
        yield Target("growth of the replica", round(100 * (after / before - 1), 1), "%", at_most=GROWTH, note=note)
        is_well = client.post(ACTION, content=BODY).status_code == 200 and replica.is_running()
        yield Target("the same replica answers at the end", int(is_well), at_least=1)


def _warm_up(client: httpx.Client, statuses: Counter[str], count: int, number: int) -> None:
    """The first tenth, in which memory is allocated once."""
    for _ in range(200):
        client.post(ACTION, content=BODY)
    client.get("/openapi.json")
    _changed(client, statuses, count, number + 1)


def _from_document(client: httpx.Client, statuses: Counter[str], count: int, number: int) -> None:
    schema = schemathesis.openapi.from_dict(client.get("/openapi.json").json())
    operations = [operation.ok() for operation in schema.get_all_operations()]
    acting = [operation for operation in operations if operation.path in ROUTES]
    names = {"model": LEAGUE, "league": LEAGUE, "alias": "candidate", "version": "1", "position": 0}
    names |= dict.fromkeys(("evaluation", "game", "run", "schedule", "verdict"), "1")
    left = count

    @seed(number)
    @settings(
        max_examples=count,
        database=None,
        phases=[Phase.generate],
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(data=st.data())
    def send(data: st.DataObject) -> None:
        nonlocal left
        operation = data.draw(st.sampled_from(acting) | st.sampled_from(operations))
        named = (
            {parameter.name: names[parameter.name] for parameter in operation.path_parameters}
            if data.draw(st.booleans())
            else None
        )
        with suppress(schemathesis.errors.SchemathesisError):  # an operation without parameters cannot be violated
            case = data.draw(operation.as_strategy(data.draw(st.sampled_from(GenerationMode)), path_parameters=named))
            case.method = operation.method.upper()
            made = requests.Request(**case.as_transport_kwargs(base_url=str(client.base_url))).prepare()
            headers = {name: value for name, value in made.headers.items() if name.lower() != "x-request-timeout-ms"}
            content = made.body.encode() if isinstance(made.body, str) else made.body
            if left > 0:
                left -= 1
                _send(client, statuses, str(made.method), str(made.url), content, headers)

    while left > 0:
        send()


def _changed(client: httpx.Client, statuses: Counter[str], count: int, number: int) -> None:
    random = Random(number)
    valid = list(_valid_requests())
    for _ in range(count):
        path, body, headers = random.choice(valid)
        _send(client, statuses, "POST", path, _damaged(body, random), headers)


def _send(
    client: httpx.Client, statuses: Counter[str], method: str, url: str, body: bytes | None, headers: dict[str, str]
) -> None:
    try:
        with client.stream(method, url, content=body, headers=headers) as response:
            statuses[str(response.status_code)] += 1
            if not response.headers.get("content-type", "").startswith("text/event-stream"):  # which does not end
                response.read()
    except (httpx.InvalidURL, httpx.LocalProtocolError, UnicodeError):
        statuses["not sent"] += 1
    except httpx.TransportError:
        statuses["dropped"] += 1


def _stream(url: str, statuses: Counter[str], count: int, number: int) -> None:
    random = Random(number)
    binary = message_of([PLANES[None], _mask()], rows=1, seed=3, explore=True)
    text = json.dumps(json.loads(BODY) | {"reset": True, "return_state": True}).encode()
    address = url.replace("http://", "ws://") + f"/v1/policies/{LEAGUE}/stream"
    left = count
    while left > 0:
        with suppress(ConnectionClosed), connect(address, compression=None) as stream:
            while left > 0:
                left -= 1
                whole, is_text = random.choice([(binary, False), (text, True)])
                message = _damaged(whole, random)
                status = "dropped"
                try:
                    status = _exchange(stream, message.decode("utf-8", "replace") if is_text else message)
                finally:
                    statuses[status] += 1


def _exchange(stream: ClientConnection, message: str | bytes) -> str:
    """The status of an answer, 200 if it has none."""
    stream.send(message)
    answer = stream.recv(timeout=30)
    return str(json.loads(answer).get("status", 200)) if isinstance(answer, str) else "200"


def _valid_requests() -> Iterator[Request]:
    action, infer = (path.replace("{model}", LEAGUE) for path in ROUTES)
    board = {"observation": {"b64": b64encode(PLANES.tobytes()).decode()}, "action_mask": [1] * 7}
    for document in (
        json.loads(BODY),
        {
            "observations": [json.loads(BODY)["observation"]] * 3,
            "explore": True,
            "seed": [1, 2, 3],
            "probabilities": True,
        },
        {"observation": board, "state": None},
    ):
        yield action, json.dumps(document).encode(), {}
    mask = _mask()
    inputs = [
        {"name": "observation", "datatype": "INT8", "shape": [1, 6, 7, 2]},
        {"name": "action_mask", "datatype": "INT8", "shape": [1, 7]},
    ]
    listed = [tensor | {"data": array.ravel().tolist()} for tensor, array in zip(inputs, (PLANES, mask), strict=True)]
    plain = json.dumps({"inputs": listed, "outputs": [{"name": "action"}]}).encode()
    sized = [
        tensor | {"parameters": {"binary_data_size": array.size}}
        for tensor, array in zip(inputs, (PLANES, mask), strict=True)
    ]
    head = json.dumps({"inputs": sized, "parameters": {"binary_data_output": True}}).encode()
    binary, length = head + PLANES.tobytes() + mask.tobytes(), {"inference-header-content-length": str(len(head))}
    yield infer, plain, {}
    yield infer, binary, length
    yield infer, gzip.compress(plain), {"content-encoding": "gzip"}
    yield infer, zlib.compress(binary), length | {"content-encoding": "deflate"}


def _mask() -> Any:
    return PLANES.reshape(-1)[:7].copy() | 1


def _damaged(body: bytes, random: Random) -> bytes:
    """A body with up to four changes."""
    for _ in range(random.randint(0, 4)):
        change: Callable[[bytes, Random], bytes] = random.choice([_flip, _cut, _put, _swap])
        body = change(body, random)
    return body


def _flip(body: bytes, random: Random) -> bytes:
    at = random.randrange(len(body) + 1)
    return body[:at] + random.randbytes(random.randint(1, 4)) + body[at + random.randint(1, 4) :]


def _cut(body: bytes, random: Random) -> bytes:
    at = random.randrange(len(body) + 1)
    return body[:at] + body[at + random.choice([1, 16, 10_000]) :]


def _put(body: bytes, random: Random) -> bytes:
    at = random.randrange(len(body) + 1)
    return (
        body[:at] + random.choice([b"[" * 500, b'"', b"{}", b"9" * 40, bytes(50), b"\xff", b"null", b":"]) + body[at:]
    )


def _swap(body: bytes, random: Random) -> bytes:
    """Replace one value of a JSON object by an invalid one, if the body is one."""
    with suppress(ValueError, RecursionError):
        document = json.loads(body)
        at = document
        while isinstance(at, dict | list) and at:
            key = random.choice(list(at) if isinstance(at, dict) else range(len(at)))
            if not isinstance(at[key], dict | list) or not at[key] or random.random() < 0.3:
                at[key] = random.choice(INVALID_VALUES)
                break
            at = at[key]
        return json.dumps(document).encode()
    return body
