"""Calls without a key, with the longest names that the server reads: how much do the replicas grow?"""

import secrets
from collections.abc import Iterator
from pathlib import Path

import grpc
import httpx

from benchmarks.harness import Target
from benchmarks.processes import replica_processes
from serve_app.inference_protocol import open_inference_pb2 as messages

GROWTH = 10.0
"""Maximum growth of a replica, in MB."""
PATH = 60_000
"""Characters of a path; HAProxy and uvicorn read headers of about 64 KiB."""
NAME = 4_000_000
"""Characters of a name over gRPC, whose messages have at most 4 MiB."""
SERVICE = "/inference.GRPCInferenceService/ModelReady"


def unauthenticated(url: str, grpc_address: str, calls: int, home: Path) -> Iterator[Target]:
    """The growth of the replica that grew most. home: LEAGUE_HOME of the server."""
    with httpx.Client(base_url=url, timeout=30) as client:
        _call_http(client, 4)
        _call_grpc(grpc_address, 4)
        before = {replica.pid: replica.memory_info().rss for replica in replica_processes(home)}
        refused = _call_http(client, calls // 2) + _call_grpc(grpc_address, calls - calls // 2)
    growth = max(replica.memory_info().rss - before[replica.pid] for replica in replica_processes(home)) / 2**20
    yield Target("calls without a key: growth of a replica", round(growth, 1), "MB", at_most=GROWTH)
    yield Target("calls without a key that were not refused", calls - refused, at_most=0, note=f"of {calls:,}")


def _call_http(client: httpx.Client, calls: int) -> int:
    """Each path is new, so that nothing that is kept for it can be shared."""
    refused = 0
    for number in range(calls):
        name = secrets.token_hex(PATH // 2)
        path = f"/v1/policies/{name}/action" if number % 2 else f"/v1/leagues/{name}"
        refused += client.request("POST" if number % 2 else "GET", path).status_code in (400, 401, 404, 414, 431)
    return refused


def _call_grpc(address: str, calls: int) -> int:
    refused = 0
    with grpc.insecure_channel(address, [("grpc.max_send_message_length", -1)]) as channel:
        call = channel.unary_unary(
            SERVICE,
            request_serializer=messages.ModelReadyRequest.SerializeToString,
            response_deserializer=messages.ModelReadyResponse.FromString,
        )
        for _ in range(calls):
            try:
                call(messages.ModelReadyRequest(name=secrets.token_hex(NAME // 2)), timeout=30)
            except grpc.RpcError:
                refused += 1
    return refused
