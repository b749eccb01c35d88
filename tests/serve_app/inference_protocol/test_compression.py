"""Compressed bodies: whole and within the limit, or refused before they grow."""

import asyncio
import tracemalloc
import zlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from league.errors import BodyTooLarge
from serve_app.error_handlers import MalformedBody
from serve_app.inference_protocol.compression import WORTHWHILE, compressed, decompressed


@settings(deadline=None)
@given(body=st.binary(min_size=WORTHWHILE, max_size=4 * WORTHWHILE), encoding=st.sampled_from([b"gzip", b"deflate"]))
def test_what_is_compressed_comes_back(body: bytes, encoding: bytes) -> None:
    async def round_trip() -> bytes:
        packed, chosen = await compressed(body, encoding)
        assert chosen == encoding
        return await decompressed(packed, encoding, len(body))

    assert asyncio.run(round_trip()) == body


def test_the_limit_is_that_of_the_decompressed_body() -> None:
    body = zlib.compress(bytes(1000))
    assert asyncio.run(decompressed(body, b"deflate", 1000)) == bytes(1000)
    with pytest.raises(BodyTooLarge, match="larger than 999 bytes"):
        asyncio.run(decompressed(body, b"deflate", 999))


def test_a_bomb_takes_no_memory() -> None:
    bomb = zlib.compress(bytes(200 * 2**20))
    tracemalloc.start()
    with pytest.raises(BodyTooLarge):
        asyncio.run(decompressed(bomb, b"deflate", 2**20))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 8 * 2**20


@settings(deadline=None)
@given(body=st.binary(max_size=100), encoding=st.sampled_from([b"gzip", b"deflate"]))
def test_other_bytes_are_malformed(body: bytes, encoding: bytes) -> None:
    with pytest.raises(MalformedBody):
        asyncio.run(decompressed(body, encoding, 1000))
