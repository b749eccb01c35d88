"""Recurrent state as a token: text that a client returns as it got it, one for each episode.

A token names the policy and the version that gave it, and goes on with that version alone: what a number of the state
means, the next version may have learned otherwise. It is base64 (RFC 4648, the alphabet for URLs, without padding) of

    format 1 · version · first half of the manifest's digest · length of the model's name · name · state · digest

The state is one row of each recurrent input, in the order of their names, little-endian. The digest tells a damaged
token; it is no signature, for whoever may ask for actions may also send whatever state he likes, as tensors.
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
FROM_URL = str.maketrans("-_", "+/", "+/=")
"""To the alphabet that binascii reads; what does not belong into a token is left out, and so damages it."""


class Token(NamedTuple):
    """What a token holds."""

    model: str
    """`{league}.{policy}`"""
    version: int
    manifest: bytes
    """The first 16 bytes of the digest of the version's manifest."""
    state: bytes


def write_tokens(model: str, version: int, sha256: str, state: dict[str, NDArray]) -> list[str]:
    """A token for each row of a state (k, …)."""
    head = _head(model, version, bytes.fromhex(sha256)[:16])
    columns = [array.astype(array.dtype.newbyteorder("<"), copy=False) for _, array in sorted(state.items())]
    rows = len(columns[0])
    return [_sealed(head + b"".join(column[row].tobytes() for column in columns)) for row in range(rows)]


def read_token(text: Any) -> Token:
    """Raises InvalidState, unless it is a token, whole."""
    if type(text) is not str:
        raise InvalidState(
            "state must be null or the state of an earlier reply, which is a string for each observation"
        )
    try:
        data = binascii.a2b_base64(text.translate(FROM_URL) + "=" * (-len(text) % 4), strict_mode=True)
        found, version, manifest, length = HEAD.unpack_from(data)
        begin, end = HEAD.size + length, len(data) - DIGEST
        whole = found == FORMAT and begin <= end and _digest(data[:end]) == data[end:]
        model = data[HEAD.size : begin].decode("ascii") if whole else ""
    except (binascii.Error, ValueError, struct.error):
        whole = False
    if not whole:
        raise InvalidState("state is no token of an earlier reply, or not all of it")
    return Token(model, version, manifest, data[begin:end])


def common_version(tokens: Sequence[Token]) -> int:
    """The version that all of them name. Raises InvalidState."""
    versions = {token.version for token in tokens}
    if len(versions) > 1:
        told = ", ".join(map(str, sorted(versions)[:8]))
        raise InvalidState(f"state is of several versions ({told}): ask for the observations of each by themselves")
    return versions.pop()


def read_state(
    tokens: Sequence[Token | None], model: str, sha256: str, leaves: Sequence[tuple[str, Leaf]]
) -> dict[str, NDArray]:
    """The state of a batch, zeros where there is no token. Raises InvalidState if a token is of something else."""
    expected = bytes.fromhex(sha256)[:16]
    size = sum(_size(leaf) for _, leaf in leaves)
    for token in tokens:
        if token is None:
            continue
        if token.model != model:
            raise InvalidState(f"state is of {token.model}, not of {model}")
        if token.manifest != expected:
            raise InvalidState(f"state is of another version {token.version} of {model} than there is here")
        if len(token.state) != size:
            raise InvalidState(f"state has {len(token.state)} bytes, expected {size}")
    joined = b"".join(bytes(size) if token is None else token.state for token in tokens)
    rows = np.frombuffer(joined, np.uint8).reshape(len(tokens), size)
    state, at = {}, 0
    for name, leaf in sorted(leaves, key=itemgetter(0)):
        column = np.ascontiguousarray(rows[:, at : at + _size(leaf)])
        array = column.view(np.dtype(leaf.dtype).newbyteorder("<")).reshape(len(tokens), *leaf.shape)
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise InvalidState("state holds NaN or infinity")
        state[name] = array.astype(leaf.dtype, copy=False)
        at += _size(leaf)
    return state


def _head(model: str, version: int, manifest: bytes) -> bytes:
    name = model.encode("ascii")
    return HEAD.pack(FORMAT, version, manifest, len(name)) + name


def _sealed(data: bytes) -> str:
    return urlsafe_b64encode(data + _digest(data)).rstrip(b"=").decode("ascii")


def _digest(data: bytes) -> bytes:
    return blake2b(data, digest_size=DIGEST).digest()


def _size(leaf: Leaf) -> int:
    return prod(leaf.shape) * np.dtype(leaf.dtype).itemsize
