"""The protocol of a stream without I/O: messages, responses, and the state that survives a lost connection.

A stream is pinned to the version with which it opens and requests the same version when it reconnects. The server holds
the recurrent state but also returns it with each response. After a reconnection the episode continues from the last
response, because messages without a response were not applied.
"""

from collections.abc import Mapping

import httpx
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException

from policy_league_client.endpoint import Endpoint
from policy_league_client.errors import BodyTooLarge, LeagueError, RemoteError, Unauthenticated, one_line
from policy_league_client.proxies import through_proxy
from policy_league_client.refs import CHAMPION
from policy_league_client.requests import ActionRequest, BatchActionRequest, to_json
from policy_league_client.responses import (
    ActionResponse,
    BatchActionResponse,
    Model,
    parse_action_response,
    parse_batch_action_response,
)
from policy_league_client.retries import Outcome, Retries, parse_error, parse_object

OK = 200
PERMANENT_CLOSE_CODES: dict[int, type[LeagueError]] = {
    1008: Unauthenticated,
    1009: BodyTooLarge,
    1002: RemoteError,
    1007: RemoteError,
}
"""Close codes after which the same message would fail again."""
CONNECTION_ERRORS = (WebSocketException, OSError, EOFError)
"""Errors after which a connection cannot be used."""


class StreamProtocol:
    """State of a stream across connections.

    follow: each response comes from the version that the alias points to at that moment.
    """

    def __init__(self, endpoint: Endpoint, model: Model, follow: bool) -> None:
        self._endpoint = endpoint
        self._model = model
        self._follow = follow
        self._replica = ""
        self._state: str | list[str] | None = None
        self._has_state = True
        self._is_new = True
        self.last: ActionResponse | BatchActionResponse | None = None

    @property
    def url(self) -> str:
        """The URL of the next connection."""
        version = self._model.version
        query = f"?follow={version or CHAMPION}" if self._follow else self._model.query
        if self._follow and self.last is not None:
            query += f"&version={self.last.version}"  # an episode keeps the member of a mixture
        return f"{self._endpoint.websocket_url}{self._model.path}/stream{query}"

    @property
    def version(self) -> int | None:
        """The version that answers."""
        if self.last is not None:
            return self.last.version
        return self._model.version if isinstance(self._model.version, int) else None

    def opened(self, headers: Mapping[str, str]) -> None:
        """Process the headers of the handshake and pin the version in them. Raises RemoteError."""
        version = headers.get("x-league-version", "")
        if not version.isdecimal():
            raise RemoteError(f"{self.url} is not a stream of a policy server: its handshake contains no version")
        self._replica = headers.get("x-league-replica", "")
        self._is_new = True
        if not self._follow:
            self._model = self._model.at(int(version))

    def message(self, request: ActionRequest | BatchActionRequest, reset: bool | list[bool]) -> str:
        """Return the message for a request. The first one of a connection includes the recurrent state."""
        body = dict(request.body)
        if self._has_state:
            body["return_state"] = True
        if self._is_new and self._state is not None and reset is not True:
            body["state"] = self._state
            # Rows in which an episode starts have no state.
            if isinstance(reset, list) and isinstance(self._state, list):
                body["state"] = [None if starts else state for starts, state in zip(reset, self._state, strict=False)]
        elif reset:
            body["reset"] = reset
        return to_json(body).decode()

    def receive(self, request: ActionRequest | BatchActionRequest, message: str | bytes) -> Outcome | None:
        """Process a message from the server.

        Returns None if the message is not a response, else an outcome; with status 200, `last` is the response.
        Raises RemoteError.
        """
        body = parse_object(message)
        if body is None:
            raise RemoteError(f"{self.url} did not return a JSON object: {message[:200]!r}")
        if "closing" in body:
            return None
        if "code" in body:
            status = body.get("status", 500)
            headers = {"retry-after": str(body["retry_after"])} if "retry_after" in body else {}
            return httpx.Response(status, headers=headers, content=message)
        if isinstance(request, BatchActionRequest):
            self.last = parse_batch_action_response(body, self._replica, request.seed)
        else:
            self.last = parse_action_response(body, self._replica, request.seed)
        self._state, self._is_new = body.get("state"), False
        self._has_state = self._state is not None or self._follow
        return httpx.Response(OK)

    def connection_lost(self, error: Exception) -> Outcome:
        """Return the outcome of a message whose connection was refused or lost. Raises LeagueError if it is final."""
        if isinstance(error, InvalidStatus):
            response = error.response
            headers = dict(response.headers.raw_items())
            return httpx.Response(response.status_code, headers=headers, content=bytes(response.body or b""))
        if isinstance(error, ConnectionClosed) and error.rcvd is not None and error.rcvd.code in PERMANENT_CLOSE_CODES:
            kind = PERMANENT_CLOSE_CODES[error.rcvd.code]
            raise kind(f"{self.url} was closed: {error.rcvd.reason or error}") from error
        return httpx.ReadError(f"the connection{through_proxy(self._endpoint.url)} was lost: {one_line(error)}")

    def next_delay(self, retries: Retries, outcome: Outcome) -> float | None:
        """Return the seconds until the message is sent again, None after a response.

        Raises the LeagueError that corresponds to a final failure.
        """
        if isinstance(outcome, httpx.Response) and outcome.status_code == OK:
            return None
        if (delay := retries.next_delay(outcome)) is not None:
            return delay
        if isinstance(outcome, httpx.Response):
            raise parse_error(outcome, self.url)
        raise RemoteError(f"{self.url}: {outcome}") from outcome
