"""Compressed bodies are decompressed within the limit, or rejected before they grow."""

import asyncio
import zlib
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from league.errors import BodyTooLarge
from serve_app.access import request_body
from serve_app.access.errors import MalformedBody
from serve_app.access.request_body import decompressed
from serve_app.inference_protocol.rest_codec import MIN_COMPRESSED_BYTES, compressed


@settings(deadline=None)
@given(
    body=st.binary(min_size=MIN_COMPRESSED_BYTES, max_size=4 * MIN_COMPRESSED_BYTES),
    encoding=st.sampled_from([b"gzip", b"deflate"]),
)
def test_bodies_survive_compression(body: bytes, encoding: bytes) -> None:
    async def round_trip() -> bytes:
        compressed_body, chosen = await compressed(body, encoding)
        assert chosen == encoding
        return await decompressed(compressed_body, encoding, len(body))

    assert asyncio.run(round_trip()) == body


def test_the_limit_applies_to_the_decompressed_body() -> None:
    body = zlib.compress(bytes(1000))
    assert asyncio.run(decompressed(body, b"deflate", 1000)) == bytes(1000)
    with pytest.raises(BodyTooLarge, match="larger than 999 bytes"):
        asyncio.run(decompressed(body, b"deflate", 999))


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
    with pytest.raises(BodyTooLarge):
        asyncio.run(decompressed(bomb, b"deflate", 2**20))
    assert sizes == [2**20 + 1]


@settings(deadline=None)
@given(body=st.binary(max_size=100), encoding=st.sampled_from([b"gzip", b"deflate"]))
def test_other_bytes_are_malformed(body: bytes, encoding: bytes) -> None:
    with pytest.raises(MalformedBody):
        asyncio.run(decompressed(body, encoding, 1000))
