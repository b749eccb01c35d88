"""What the JSON of a request to a policy may consist of, derived from the policy's spaces.

The interpreter serves nobody else while it parses JSON or converts lists to an array, also in a thread: four megabytes
of brackets take half a second. A large body is therefore compared with the largest valid request before it is parsed,
and with its number of observations before it is converted.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from math import prod

import numpy as np

from league.errors import BodyTooLarge
from league.spaces import Leaf

LARGE_BODY = 32 * 1024
"""Bodies of more bytes are checked before they are parsed, are parsed in a thread, and count as several requests."""
NUMBER_SIZE = 40
"""Bytes of a number, or of the brackets of a list, with separators: a double has up to 24 digits."""
LEAF_SIZE = 512
"""Bytes for the keys of a leaf, and the headers of a small image."""
LEAF_COMMAS = 8
"""Commas of a leaf in base64, with its dtype and shape."""
OVERHEAD_SIZE = 8 * 1024
"""Bytes of a request apart from its observations and recurrent states."""
OVERHEAD = 1024
"""Brackets and commas of a request apart from its observations and recurrent states."""


@dataclass(frozen=True, slots=True)
class RequestLimits:
    """Limits per observation, with its recurrent state."""

    size: int
    """Bytes."""
    brackets: int
    """Lists and objects."""
    commas: int

    @classmethod
    def of(cls, leaves: Iterable[Leaf]) -> "RequestLimits":
        """The limits of a policy whose observation and recurrent state have these leaves."""
        shapes = [leaf.shape for leaf in leaves]
        numbers = sum(map(prod, shapes))
        lists = sum(prod(shape[:axes]) for shape in shapes for axes in range(len(shape)))
        return cls(
            size=NUMBER_SIZE * (numbers + lists) + LEAF_SIZE * (len(shapes) + 1),
            # An object contains at least one leaf; a leaf in base64 is an object with a list.
            brackets=lists + 3 * len(shapes) + 1,
            commas=numbers + lists + LEAF_COMMAS * (len(shapes) + 1),
        )

    def check_body(self, body: bytes | memoryview, max_batch: int) -> None:
        """Raise BodyTooLarge if no valid request of `max_batch` observations is as large as a body."""
        self.check_size(len(body), max_batch)
        characters = np.frombuffer(body, np.uint8)
        opened = _count(characters, b"[") + _count(characters, b"{")
        if opened > (limit := max_batch * self.brackets + OVERHEAD):
            raise BodyTooLarge(f"the body has {opened} lists and objects, expected at most {limit}")
        if (commas := _count(characters, b",")) > (limit := max_batch * self.commas + OVERHEAD):
            raise BodyTooLarge(f"the body has {commas} commas, expected at most {limit}")

    def check_size(self, size: int, rows: int) -> None:
        """Raise BodyTooLarge if a body is larger than any valid request of `rows` observations."""
        if size > (limit := rows * self.size + OVERHEAD_SIZE):
            raise BodyTooLarge(f"the body has {size} bytes, expected at most {limit} for {rows} observations")


def _count(characters: np.ndarray, character: bytes) -> int:
    return int(np.count_nonzero(characters == character[0]))
