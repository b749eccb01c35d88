"""Encodes recurrent state as tokens: opaque text that a client sends back unchanged, one per episode.

A token names the policy and version that wrote it and is valid for that version only, because another version may
interpret the numbers differently. It is base64 (RFC 4648, URL alphabet, without padding) of

    format 1 · version · first half of the manifest digest · length of the model name · name · state · digest

The state is one row of each recurrent input, ordered by name, little-endian. The digest detects damage; it is not a
signature, because a client that may request actions may also send any state as tensors.
"""

import binascii
import struct
from base64 import urlsafe_b64encode
from collections.abc import Sequence
from hashlib import blake2b
from math import prod
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from league.errors import InvalidState
from league.spaces import Leaf

FORMAT = 1
HEAD = struct.Struct("<BI16sH")
DIGEST = 8
FROM_URL_ALPHABET = str.maketrans("-_", "+/", "+/=")
"""Maps to the standard alphabet, and removes characters that are invalid in a token so that decoding fails."""


class StateToken(NamedTuple):
    """The contents of a token."""

    model: str
    """`{league}.{policy}`"""
    version: int
    manifest: bytes
    """The first 16 bytes of the digest of the version's manifest."""
    state: bytes


def write_tokens(model: str, version: int, sha256: str, state: dict[str, NDArray]) -> list[str]:
    """Encode each row of a state (k, …)."""
    name = model.encode("ascii")
    head = HEAD.pack(FORMAT, version, bytes.fromhex(sha256)[:16], len(name)) + name
    columns = [array.astype(array.dtype.newbyteorder("<"), copy=False) for _, array in sorted(state.items())]
    tokens = []
    for row in range(len(columns[0])):
        data = head + b"".join(column[row].tobytes() for column in columns)
        tokens.append(urlsafe_b64encode(data + _digest(data)).rstrip(b"=").decode("ascii"))
    return tokens


def read_token(text: Any) -> StateToken:
    """Decode a token. Raises InvalidState if it is malformed or damaged."""
    if type(text) is not str:
        raise InvalidState("state must be null or the state of an earlier response: one string per observation")
    try:
        data = binascii.a2b_base64(text.translate(FROM_URL_ALPHABET) + "=" * (-len(text) % 4), strict_mode=True)
        token_format, version, manifest, length = HEAD.unpack_from(data)
        begin, end = HEAD.size + length, len(data) - DIGEST
        whole = token_format == FORMAT and begin <= end and _digest(data[:end]) == data[end:]
        model = data[HEAD.size : begin].decode("ascii") if whole else ""
    except (binascii.Error, ValueError, struct.error):
        whole = False
    if not whole:
        raise InvalidState("state is not a complete token of an earlier response")
    return StateToken(model, version, manifest, data[begin:end])


def common_version(tokens: Sequence[StateToken]) -> int:
    """The version that all tokens name. Raises InvalidState."""
    versions = {token.version for token in tokens}
    if len(versions) > 1:
        listed = ", ".join(map(str, sorted(versions)[:8]))
        raise InvalidState(f"state is of several versions ({listed}): send one request per version")
    return versions.pop()


def read_state(
    tokens: Sequence[StateToken | None], model: str, sha256: str, leaves: Sequence[tuple[str, Leaf]]
) -> dict[str, NDArray]:
    """The state of a batch, with zeros where the token is None. Raises InvalidState if a token does not match."""
    expected = bytes.fromhex(sha256)[:16]
    size = sum(_size(leaf) for _, leaf in leaves)
    for token in tokens:
        if token is None:
            continue
        if token.model != model:
            raise InvalidState(f"state is of {token.model}, expected {model}")
        if token.manifest != expected:
            raise InvalidState(
                f"state is of a different version {token.version} of {model} than the one in this registry"
            )
        if len(token.state) != size:
            raise InvalidState(f"state has {len(token.state)} bytes, expected {size}")
    joined = b"".join(bytes(size) if token is None else token.state for token in tokens)
    rows = np.frombuffer(joined, np.uint8).reshape(len(tokens), size)
    state, at = {}, 0
    for name, leaf in sorted(leaves, key=itemgetter(0)):
        column = np.ascontiguousarray(rows[:, at : at + _size(leaf)])
        array = column.view(np.dtype(leaf.dtype).newbyteorder("<")).reshape(len(tokens), *leaf.shape)
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise InvalidState("state contains NaN or infinity")
        state[name] = array.astype(leaf.dtype, copy=False)
        at += _size(leaf)
    return state


def _digest(data: bytes) -> bytes:
    return blake2b(data, digest_size=DIGEST).digest()


def _size(leaf: Leaf) -> int:
    return prod(leaf.shape) * np.dtype(leaf.dtype).itemsize
