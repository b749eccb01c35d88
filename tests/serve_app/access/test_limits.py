"""The key cache of a replica; limits of rates, connections, queues and bodies."""

import asyncio
import gzip
import json
import resource
import zlib
from contextlib import ExitStack, suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from types import SimpleNamespace
from typing import Any
from unittest.mock import AsyncMock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from starlette.testclient import TestClient
from starlette.types import Message

from league.errors import BodyTooLarge, Overloaded
from league.registry.keys import digest
from league.registry.registry import Registry
from league.registry.storage.rows import KeyRow
from serve_app.access import request_body
from serve_app.access.api_keys import ApiKey, ApiKeyCache, TokenBucket
from serve_app.access.connection_limit import ConnectionLimit, within_descriptors
from serve_app.access.errors import MalformedBody
from serve_app.access.load_shedding import Backlog
from serve_app.access.request_body import WINDOW_BITS, decompressed, read_bytes
from serve_app.app import Replica
from tests.support.clients.actions import inference
from tests.support.examples import examples
from tests.support.leagues.served_leagues import promote
from tests.support.servers.replicas import QUICK

TOKEN = b"plk_00000000_" + b"a" * 64


def row(name: str = "bot", rate: float | None = 1.0) -> KeyRow:
    return KeyRow(
        id=name,
        name=name,
        sha256=digest(TOKEN),
        scopes=frozenset(["act"]),
        leagues=None,
        rate=rate,
        created_at=datetime.now(UTC),
        expires_at=None,
        revoked_at=None,
    )


ROW = row()


@pytest.fixture
def api_keys() -> ApiKeyCache:
    api_keys = ApiKeyCache()
    assert api_keys.is_empty
    api_keys.update([ROW])
    return api_keys


def test_a_key_is_found_by_its_token_only(api_keys: ApiKeyCache) -> None:
    key = api_keys.find(TOKEN)
    assert key is not None
    assert (key.name, key.id, key.scopes, key.leagues) == ("bot", "bot", {"act"}, None)
    for wrong in (b"", TOKEN[:-1], TOKEN + b"a", TOKEN[:-1] + b"b", digest(TOKEN).encode(), b"\xff" * len(TOKEN)):
        assert api_keys.find(wrong) is None


def test_an_expired_or_revoked_key_is_not_found_but_the_cache_is_not_empty(api_keys: ApiKeyCache) -> None:
    date = datetime.now(UTC)
    for change in ({"expires_at": date - timedelta(seconds=1)}, {"revoked_at": date}):
        api_keys.update([replace(ROW, **change)])
        assert api_keys.find(TOKEN) is None
        assert not api_keys.is_empty, "an empty cache would unlock the server"
    api_keys.update([replace(ROW, expires_at=date + timedelta(hours=1))])
    assert api_keys.find(TOKEN)


def test_an_update_does_not_reset_the_rate_limit(api_keys: ApiKeyCache) -> None:
    waits = []
    for _ in range(2):
        key = api_keys.find(TOKEN)
        assert key is not None
        assert key.bucket is not None
        waits.append(key.bucket.take())
        api_keys.update([ROW])
    assert waits[0] == 0 < waits[1]


class Clock:
    now: float = 100.0

    def __call__(self) -> float:
        return self.now


def test_a_burst_of_one_second_is_allowed() -> None:
    clock = Clock()
    bucket, slow = TokenBucket(5, clock), TokenBucket(1 / 60, clock)
    assert [bucket.take() for _ in range(5)] == [0] * 5
    assert bucket.take() == pytest.approx(0.2)
    assert [slow.take(), slow.take()] == [0, pytest.approx(60)]
    clock.now += 0.21
    assert bucket.take() == 0
    assert bucket.take() > 0
    clock.now += 61
    assert slow.take() == 0


@examples(60)
@given(rate=st.floats(0.01, 1000), gaps=st.lists(st.floats(0, 2), min_size=1, max_size=200))
def test_the_rate_plus_a_burst_is_never_exceeded(rate: float, gaps: list[float]) -> None:
    clock = Clock()
    bucket = TokenBucket(rate, clock)
    begin, admitted = clock.now, 0
    for gap in gaps:
        clock.now += gap
        admitted += bucket.take() == 0
        assert admitted <= max(1, rate) + rate * (clock.now - begin) + 1e-6


def test_tokens_can_be_owed_once() -> None:
    clock = Clock()
    bucket = TokenBucket(10, clock)
    assert bucket.take() == 0
    assert bucket.owe(109) == 0
    assert bucket.take() == pytest.approx(10.1)
    assert bucket.owe(1) == pytest.approx(10)
    clock.now += 10.15
    assert bucket.take() == 0
    assert bucket.take() > 0


def key(name: str) -> ApiKey:
    return ApiKey(row(name, rate=None), None)


def test_connections_are_limited_in_total_and_per_key() -> None:
    limit, one, other = ConnectionLimit("streams", 5, 2), key("one"), key("other")
    with ExitStack() as stack:
        for opened in (one, one, other, None):
            stack.enter_context(limit.opened(opened))
        with pytest.raises(Overloaded, match="2 streams of the key one are open in this replica"), limit.opened(one):
            pass
        stack.enter_context(limit.opened(other))
        with pytest.raises(Overloaded, match="5 streams are open in this replica"), limit.opened(None):
            pass
        assert limit.open == 5
    assert limit.open == 0
    with limit.opened(one), limit.opened(one):
        assert limit.open == 2


def test_a_connection_that_fails_is_not_counted_any_more() -> None:
    limit = ConnectionLimit("streams", 1, 1)
    for _ in range(3):
        with pytest.raises(ZeroDivisionError), limit.opened(key("one")):
            raise ZeroDivisionError
    assert limit.open == 0


def test_connections_leave_file_descriptors_for_the_rest_of_the_process() -> None:
    descriptors, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    assert within_descriptors(2) == 2
    assert within_descriptors(descriptors) < descriptors


pytestmark = pytest.mark.anyio
MAX_WAIT = 0.25


class Loop:
    """A backlog with a controlled duration of the requests in each turn of the event loop."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.backlog = Backlog(MAX_WAIT, lambda: self.now)

    async def turn(self, requests: int, seconds: float) -> int:
        """The number of requests admitted in a turn, each of which takes `seconds`."""
        admitted = 0
        for _ in range(requests):
            with suppress(Overloaded):
                self.backlog.admit()
                admitted += 1
                self.now += seconds
        await asyncio.sleep(0)
        return admitted


async def test_a_turn_starts_what_it_reaches_in_time() -> None:
    loop = Loop()
    assert [await loop.turn(400, 0.0005) for _ in range(20)] == [400] * 20
    assert [await loop.turn(64, 0.0104) for _ in range(20)] == [25] * 20
    assert [await loop.turn(10, 1.0) for _ in range(5)] == [1] * 5
    assert [await loop.turn(1, 5.0) for _ in range(5)] == [1] * 5, "a single request is not a queue"


@pytest.mark.parametrize(("seconds", "requests"), [(0.01, 26), (0.001, 251), (0.0001, 2501)])
async def test_a_queue_has_as_many_requests_as_are_answered_in_time(seconds: float, requests: int) -> None:
    loop = Loop()
    loop.backlog.queued = 10_000
    assert await loop.turn(1, 0.0) == 1, "the duration of a request is not known yet"
    loop.backlog.queued = 0
    for _ in range(200):
        loop.backlog.count_answered(32, 32 * seconds)
    while await loop.turn(1, 0.0):
        loop.backlog.queued += 1
    assert loop.backlog.queued == pytest.approx(requests, abs=1)


async def test_requests_wait_for_the_queue_and_for_those_of_their_turn() -> None:
    loop = Loop()
    for _ in range(100):
        loop.backlog.count_answered(1, 0.001)
    loop.backlog.queued = 200
    assert await loop.turn(100, 0.0101) == 5


DISCONNECT: Message = {"type": "http.disconnect"}


VECTOR = {
    "/v1/policies/vector/action": {"observation": [0.5, -1]},
    "/v2/models/vector/infer": inference({"observation": np.array([[0.5, -1]], np.float32)}),
}
COMPRESSED = gzip.compress(b"{}", mtime=0)
UNREADABLE = (
    ("gzip", b"no gzip", 400, "cannot be decompressed"),
    ("gzip", COMPRESSED[:-4], 400, "truncated or followed by other data"),
    ("gzip", COMPRESSED + b"more", 400, "truncated or followed by other data"),
    ("deflate", COMPRESSED, 400, "cannot be decompressed"),
    ("br", b"{}", 415, "the Content-Encoding is 'br', expected gzip, deflate or identity"),
    ("gzip, gzip", gzip.compress(COMPRESSED), 415, "expected gzip, deflate or identity"),
    ("gzip", gzip.compress(b" " * (QUICK.max_body + 1)), 413, "the decompressed body is larger than 65536 bytes"),
    ("deflate", zlib.compress(b" " * 20 * 2**20), 413, "the decompressed body is larger than 65536 bytes"),
    ("identity", b" " * (QUICK.max_body + 1), 413, "larger than 65536 bytes"),
    # Without Content-Length.
    ("identity", [b" " * 1024] * (QUICK.max_body // 1024 + 1), 413, "larger than 65536 bytes"),
)


def test_bodies_of_both_protocols_can_be_compressed(read_only_client: TestClient, subtests: pytest.Subtests) -> None:
    compressions = {"gzip": gzip.compress, "x-gzip": gzip.compress, "deflate": zlib.compress, "identity": bytes}
    for path, document in VECTOR.items():
        body = json.dumps(document).encode()
        expected = read_only_client.post(path, content=body).json()
        for encoding, compress in compressions.items():
            with subtests.test(path, encoding=encoding):
                headers = {"content-encoding": encoding}
                reply = read_only_client.post(path, content=compress(body), headers=headers)
                assert (reply.status_code, reply.json()) == (200, expected)
        for encoding, content, status, message in UNREADABLE:
            with subtests.test(path, message=message):
                reply = read_only_client.post(path, content=content, headers={"content-encoding": encoding})
                error = reply.json()
                assert (reply.status_code, message in error.get("message", error.get("error"))) == (status, True), error


@pytest.mark.anyio
async def test_an_incomplete_body_is_malformed() -> None:
    for before in ([], [{"type": "http.request", "body": b"{", "more_body": True}]):
        receive = AsyncMock(side_effect=[*before, DISCONNECT])
        with pytest.raises(MalformedBody, match="closed before the body was complete"):
            await read_bytes({"headers": []}, receive, 1024)


@pytest.mark.anyio
async def test_a_change_without_its_body_is_not_applied(registry: Registry) -> None:
    """An empty body is valid for a rollback, but a missing one is not an empty one."""
    promote(registry, "board", 2)
    _, token = registry.keys.create("operator", ["promote"])
    sent: list[Message] = []

    async def send(message: Message) -> None:
        sent.append(message)

    scope: dict[str, Any] = {
        "type": "http",
        "method": "POST",
        "path": "/v1/leagues/board/rollback",
        "query_string": b"",
        "headers": [(b"x-api-key", token.encode()), (b"idempotency-key", b"once"), (b"content-length", b"20")],
    }
    application = Replica(registry, QUICK, "replica-1").application()
    async with application.router.lifespan_context(application):
        await application(scope, AsyncMock(return_value=DISCONNECT), send)
    assert (sent[0]["status"], json.loads(sent[1]["body"])["code"]) == (400, MalformedBody.code)
    assert registry.aliases.current("board") == {"champion": 2}


@examples(60)
@given(body=st.binary(max_size=4096), encoding=st.sampled_from(sorted(WINDOW_BITS)))
def test_bodies_survive_compression(body: bytes, encoding: bytes) -> None:
    compressor = zlib.compressobj(wbits=WINDOW_BITS[encoding])
    content = compressor.compress(body) + compressor.flush()
    assert asyncio.run(decompressed(content, encoding, len(body))) == body


def test_a_decompression_bomb_does_not_use_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    bomb, sizes = zlib.compress(bytes(20 * 2**20)), list[int]()

    class Measured:
        def __init__(self, window_bits: int) -> None:
            self._inflater = zlib.decompressobj(window_bits)

        def decompress(self, body: bytes, most: int = 0) -> bytes:
            inflated = self._inflater.decompress(body, most)
            sizes.append(len(inflated))
            return inflated

    # No other use of zlib in the module.
    monkeypatch.setattr(request_body, "zlib", SimpleNamespace(decompressobj=Measured, error=zlib.error))
    with pytest.raises(BodyTooLarge, match="larger than 1048576 bytes"):
        asyncio.run(decompressed(bomb, b"deflate", 2**20))
    assert sizes == [2**20 + 1]


@examples(60)
@given(body=st.binary(max_size=100), encoding=st.sampled_from([b"gzip", b"deflate"]))
def test_other_bytes_are_malformed(body: bytes, encoding: bytes) -> None:
    with pytest.raises(MalformedBody):
        asyncio.run(decompressed(body, encoding, 1000))
