"""Compressed bodies: gzip and deflate (zlib's format, RFC 1950), both ways, in a thread.

A body counts against the limit as it is after decompression, which stops there: a small body cannot become a large one.
"""

import asyncio
import zlib

from league.errors import BodyTooLarge
from serve_app.error_handlers import MalformedBody, UnsupportedMediaType

WINDOW_BITS = {b"gzip": 31, b"x-gzip": 31, b"deflate": 15}
"""Of zlib, which tells the formats apart by them."""
LEVEL = 1
"""The fastest: the peer is near, or the bytes are few."""
WORTHWHILE = 1024
"""Bytes from which on a reply is compressed."""


async def decompressed(body: bytes, encoding: bytes, limit: int) -> bytes:
    """A body without its Content-Encoding. Raises UnsupportedMediaType, MalformedBody or BodyTooLarge."""
    encoding = encoding.strip().lower()
    if encoding in (b"", b"identity"):
        return body
    if encoding not in WINDOW_BITS:
        given = encoding.decode("latin-1")[:64]
        raise UnsupportedMediaType(f"the body is encoded as {given!r}, expected gzip, deflate or identity")
    return await asyncio.to_thread(_inflate, body, WINDOW_BITS[encoding], limit)


async def compressed(body: bytes, accepted: bytes) -> tuple[bytes, bytes | None]:
    """A body as the client's Accept-Encoding permits, and its Content-Encoding; small ones stay as they are."""
    encoding = _choice(accepted) if len(body) >= WORTHWHILE else None
    if encoding is None:
        return body, None
    return await asyncio.to_thread(_deflate, body, WINDOW_BITS[encoding]), encoding


def _choice(accepted: bytes) -> bytes | None:
    """The first encoding that is accepted and known. Preferences are not weighed, but `q=0` refuses."""
    for item in accepted.lower().split(b","):
        name, _, quality = item.partition(b";")
        if name.strip() in (b"gzip", b"deflate") and quality.replace(b" ", b"").strip(b"0.") != b"q=":
            return name.strip()
    return None


def _inflate(body: bytes, window_bits: int, limit: int) -> bytes:
    inflater = zlib.decompressobj(window_bits)
    try:
        inflated = inflater.decompress(body, limit + 1)
    except zlib.error as error:
        raise MalformedBody(f"the body cannot be decompressed: {error}") from None
    if len(inflated) > limit:
        raise BodyTooLarge(f"the body is larger than {limit} bytes when it is decompressed")
    if not inflater.eof or inflater.unused_data:
        raise MalformedBody("the compressed body ends too early, or something follows it")
    return inflated


def _deflate(body: bytes, window_bits: int) -> bytes:
    deflater = zlib.compressobj(LEVEL, wbits=window_bits)
    return deflater.compress(body) + deflater.flush()
