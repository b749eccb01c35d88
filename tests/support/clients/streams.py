"""Streams of a replica in this process."""

import json
from typing import Any

from starlette.testclient import TestClient, WebSocketTestSession


def open_stream(client: TestClient, model: str = "board", query: str = "", **headers: str) -> WebSocketTestSession:
    named = {name.replace("_", "-"): text for name, text in headers.items()}
    return client.websocket_connect(f"/v1/policies/{model}/stream{query}", headers=named)


def answer_to(stream: WebSocketTestSession, **message: Any) -> dict[str, Any]:
    """The answer to a message, which must not be an error."""
    answer = send(stream, message)
    assert "code" not in answer, answer
    return answer


def send(stream: WebSocketTestSession, message: Any) -> dict[str, Any]:
    stream.send_text(message if isinstance(message, str) else json.dumps(message))
    return stream.receive_json()
