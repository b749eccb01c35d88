"""Counts the fields of a gRPC message in its bytes, before it is parsed.

A field of two bytes becomes an object of a hundred: four megabytes of empty tensors would take a gigabyte, and seconds
in which the process does nothing else. Elements of packed fields are not counted; they become at most eight bytes each.
"""

from functools import cache

from google.protobuf.descriptor import Descriptor

from league.errors import BodyTooLarge
from serve_app.access.errors import MalformedBody

MAX_FIELDS = 10_000
"""Fields of a message, including those of the messages in it. A tensor has about six."""
VARINT, FIXED64, LENGTH, GROUP_START, GROUP_END, FIXED32 = range(6)
"""Wire types (https://protobuf.dev/programming-guides/encoding/)."""
VARINT_SIZE = 10
"""Maximum bytes of a variable-length integer."""


def check_fields(body: bytes, message: Descriptor) -> None:
    """Raise BodyTooLarge if a message has more than MAX_FIELDS fields, and MalformedBody if it is cut off."""
    if len(body) > MAX_FIELDS:  # a field has at least one byte
        _Scan(body, message).skip_fields(len(body), message)


class _Scan:
    def __init__(self, body: bytes, message: Descriptor) -> None:
        self._body = body
        self._message = message
        self._at = 0
        self._count = 0

    def skip_fields(self, end: int, message: Descriptor | None) -> None:
        """Skip the fields of a message that ends at `end`, and count them."""
        inner = _inner(message)
        while self._at < end:
            self._count += 1
            if self._count > MAX_FIELDS:
                raise BodyTooLarge(f"the message has more than {MAX_FIELDS} fields")
            number, wire_type = divmod(self._varint(), 8)
            if wire_type == VARINT:
                self._varint()
            elif wire_type == LENGTH:
                stop = self._varint() + self._at
                if stop <= end and number in inner:
                    self.skip_fields(stop, inner[number])
                self._at = stop
            elif wire_type in (FIXED32, FIXED64):
                self._at += 4 if wire_type == FIXED32 else 8
            elif wire_type not in (GROUP_START, GROUP_END):
                raise self._malformed()
        if self._at > end:
            raise self._malformed()

    def _varint(self) -> int:
        number = 0
        for place, byte in enumerate(self._body[self._at : self._at + VARINT_SIZE]):
            number |= (byte & 127) << 7 * place
            if byte < 128:
                self._at += place + 1
                return number
        raise self._malformed()

    def _malformed(self) -> MalformedBody:
        return malformed(self._message)


def malformed(message: Descriptor) -> MalformedBody:
    """The error for bytes that are not a message."""
    return MalformedBody(f"the message is not a valid {message.name}")


@cache
def _inner(message: Descriptor) -> dict[int, Descriptor]:
    """The messages in a message, by the number of their field."""
    return {field.number: field.message_type for field in message.fields if field.message_type is not None}
