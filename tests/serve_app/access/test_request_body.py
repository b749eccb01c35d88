"""Bodies that do not arrive completely."""

import json
from typing import Any

import pytest
from starlette.types import Message

from league.registry.registry import Registry
from serve_app.access.errors import MalformedBody
from serve_app.access.request_body import read_bytes
from serve_app.app import Replica
from tests.support.leagues.served_leagues import promote
from tests.support.servers.replicas import QUICK

DISCONNECT: Message = {"type": "http.disconnect"}


@pytest.mark.anyio
@pytest.mark.parametrize(
    "before", [[], [{"type": "http.request", "body": b"{", "more_body": True}]], ids=["none", "a part"]
)
async def test_an_incomplete_body_is_malformed(before: list[Message]) -> None:
    messages = iter([*before, DISCONNECT])

    async def receive() -> Message:
        return next(messages)

    with pytest.raises(MalformedBody, match="closed before the body was complete"):
        await read_bytes({"headers": []}, receive, 1024)


@pytest.mark.anyio
async def test_a_change_without_its_body_is_not_applied(registry: Registry) -> None:
    """An empty body is valid for a rollback, but a missing one is not an empty one."""
    promote(registry, "board", 2)
    _, token = registry.keys.create("operator", ["promote"])
    server = Replica(registry, QUICK, "replica-1")
    sent: list[Message] = []

    async def receive() -> Message:
        return DISCONNECT

    async def send(message: Message) -> None:
        sent.append(message)

    scope: dict[str, Any] = {
        "type": "http",
        "http_version": "1.1",
        "method": "POST",
        "path": "/v1/leagues/board/rollback",
        "raw_path": b"/v1/leagues/board/rollback",
        "query_string": b"",
        "headers": [(b"x-api-key", token.encode()), (b"idempotency-key", b"once"), (b"content-length", b"20")],
    }
    application = server.application()
    async with application.router.lifespan_context(application):
        await application(scope, receive, send)
    assert (sent[0]["status"], json.loads(sent[1]["body"])["code"]) == (400, MalformedBody.code)
    assert registry.aliases.current("board") == {"champion": 2}
