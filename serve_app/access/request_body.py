"""Reads request bodies, compressed or not, without buffering more than the limit.

The limit applies to the bytes that arrive, and to those that they decompress to; decompression stops there.
"""

import asyncio
import zlib
from typing import Any

import orjson
from starlette.types import Receive, Scope

from league.errors import BodyTooLarge
from league.spaces.observation_codec import json_type
from serve_app.access.errors import MalformedBody, UnsupportedMediaType

JSON_TYPES = (b"application/json", b"text/json", b"text/plain", b"application/x-www-form-urlencoded")
"""Media types accepted as JSON. The last is curl's default."""
WINDOW_BITS = {b"gzip": 31, b"x-gzip": 31, b"deflate": 15}
"""Content-Encoding → zlib's `wbits`, which select the format."""
UNCOMPRESSED = (b"", b"identity")
MAX_CHANGE_BODY = 64 * 1024
"""Limit of bodies that are not inference requests: they hold names, numbers and a reason."""
BODY_READ = "league.body_is_read"
"""Scope entry of a request whose body has arrived: a timeout after that is not the client's fault."""


async def read_body(scope: Scope, receive: Receive, limit: int) -> bytes:
    """Read a JSON body of at most `limit` bytes. Raises the errors of `read_bytes`, or UnsupportedMediaType."""
    for name, value in scope["headers"]:
        if name == b"content-type" and value not in JSON_TYPES:
            media_type = value.partition(b";")[0].strip().lower()
            if media_type not in JSON_TYPES and not media_type.endswith(b"+json"):
                type_name = media_type.decode("latin-1")[:64]
                raise UnsupportedMediaType(f"the Content-Type is {type_name!r}, expected application/json")
    return await read_bytes(scope, receive, limit)


async def read_bytes(scope: Scope, receive: Receive, limit: int) -> bytes:
    """Read a body of at most `limit` bytes, and decode its Content-Encoding.

    Raises BodyTooLarge as early as possible, MalformedBody if the connection closes before the body is complete or the
    body cannot be decompressed, and UnsupportedMediaType.
    """
    encoding = b""
    for name, value in scope["headers"]:
        if name == b"content-length":
            if int(value) > limit:
                raise _too_large(limit)
        elif name == b"content-encoding":
            encoding = value.strip().lower()
            if encoding not in WINDOW_BITS and encoding not in UNCOMPRESSED:
                encoding_name = encoding.decode("latin-1")[:64]
                raise UnsupportedMediaType(
                    f"the Content-Encoding is {encoding_name!r}, expected gzip, deflate or identity"
                )
    parts, size = list[bytes](), 0
    while True:
        message = await receive()
        if message["type"] == "http.disconnect":
            raise MalformedBody("the connection closed before the body was complete")
        body: bytes = message.get("body", b"")
        size += len(body)
        if size > limit:
            raise _too_large(limit)
        if not message.get("more_body", False):
            break
        parts.append(body)
    scope[BODY_READ] = True
    if parts:
        body = b"".join((*parts, body))
    return body if encoding in UNCOMPRESSED else await decompressed(body, encoding, limit)


async def decompressed(body: bytes, encoding: bytes, limit: int) -> bytes:
    """Decompress a body, with a key of WINDOW_BITS. Raises MalformedBody or BodyTooLarge."""
    return await asyncio.to_thread(_inflate, body, WINDOW_BITS[encoding], limit)


def parse_json_object(body: bytes) -> dict[str, Any]:
    """Parse a body as a JSON object. Raises MalformedBody."""
    try:
        document = orjson.loads(body)
    except orjson.JSONDecodeError as error:
        reason = "it is empty" if not body else str(error)
        raise MalformedBody(f"the body is not JSON: {reason}") from None
    if type(document) is not dict:
        raise MalformedBody(f"the body is {json_type(document)}, expected an object")
    return document


def _inflate(body: bytes, window_bits: int, limit: int) -> bytes:
    inflater = zlib.decompressobj(window_bits)
    try:
        inflated = inflater.decompress(body, limit + 1)
    except zlib.error as error:
        raise MalformedBody(f"the body cannot be decompressed: {error}") from None
    if len(inflated) > limit:
        raise BodyTooLarge(f"the decompressed body is larger than {limit} bytes")
    if not inflater.eof or inflater.unused_data:
        raise MalformedBody("the compressed body is truncated or followed by other data")
    return inflated


def _too_large(limit: int) -> BodyTooLarge:
    return BodyTooLarge(f"the body is larger than {limit} bytes")
