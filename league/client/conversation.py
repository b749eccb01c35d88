"""What is said over a stream, and what becomes of it when the connection is lost. Holds no connection.

A stream is pinned to the version that it opens with, and asks for that one again when it is opened anew. Recurrent
state is kept by the server, but comes along with each answer, so that an episode goes on where it was after a
reconnection: messages that were not answered were not applied.
"""

from collections.abc import Mapping
from typing import Any

import httpx
import orjson
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException

from league.client.answers import Answer, BatchAnswer, answer, batch_answer
from league.client.encoding import to_json
from league.client.endpoint import Endpoint
from league.client.faults import fault
from league.client.models import Model
from league.client.patience import Attempts, Outcome
from league.client.questions import BatchQuestion, Question
from league.errors import BodyTooLarge, LeagueError, RemoteError, Unauthenticated
from league.refs import CHAMPION

ANSWERED = 200
CLOSED_FOR: dict[int, type[LeagueError]] = {
    1008: Unauthenticated,
    1009: BodyTooLarge,
    1002: RemoteError,
    1007: RemoteError,
}
"""Close codes after which the same message would be refused again."""
LOSSES = (WebSocketException, OSError, EOFError)
"""What says that there is no connection (any more)."""


class Conversation:
    """What a stream knows beyond its connection. follow: each answer is of the alias' version of its moment."""

    def __init__(self, endpoint: Endpoint, model: Model, follow: bool) -> None:
        self._endpoint = endpoint
        self._model = model
        self._follow = follow
        self._replica = ""
        self._state: str | list[str] | None = None
        self._has_state = True
        self._is_new = True
        self.last: Answer | BatchAnswer | None = None

    @property
    def url(self) -> str:
        """Where to connect to now."""
        version = self._model.version
        query = f"?follow={version or CHAMPION}" if self._follow else self._model.query
        return f"{self._endpoint.websocket_url}{self._model.path}/stream{query}"

    @property
    def version(self) -> int | None:
        """The version that answers."""
        if self.last is not None:
            return self.last.version
        return self._model.version if isinstance(self._model.version, int) else None

    def opened(self, headers: Mapping[str, str]) -> None:
        """The server has accepted: from now on it is asked for the version that it named. Raises RemoteError."""
        version = headers.get("x-league-version", "")
        if not version.isdecimal():
            raise RemoteError(f"{self.url} is no stream of a policy server: its handshake names no version")
        self._replica = headers.get("x-league-replica", "")
        self._is_new = True
        if not self._follow:
            self._model = self._model.at(int(version))

    def message(self, question: Question | BatchQuestion, reset: bool | list[bool]) -> str:
        """What to send now. It differs after a reconnection."""
        document = dict(question.document)
        if self._has_state:
            document["return_state"] = True
        if self._is_new and self._state is not None and reset is not True:
            document["state"] = self._resumed(reset)
        elif reset:
            document["reset"] = reset
        return to_json(document).decode()

    def read(self, question: Question | BatchQuestion, message: str | bytes) -> Outcome | None:
        """Take a message: None if it is no answer to ours; else an outcome, after which `last` is the answer if its
        status is 200. Raises RemoteError."""
        try:
            document = orjson.loads(message)
        except orjson.JSONDecodeError as error:
            raise RemoteError(f"{self.url} answered what is no JSON: {message[:200]!r}") from error
        if "closing" in document:
            return None
        if "code" in document:
            status = document.get("status", 500)
            pause = {"retry-after": str(document["retry_after"])} if "retry_after" in document else {}
            return httpx.Response(status, headers=pause, content=message)
        if isinstance(question, BatchQuestion):
            self.last = batch_answer(document, self._replica, question.seed)
        else:
            self.last = answer(document, self._replica, question.seed)
        self._state, self._is_new = document.get("state"), False
        self._has_state = self._state is not None or self._follow
        return httpx.Response(ANSWERED)

    def lost(self, error: Exception) -> Outcome:
        """What a lost connection, or one that was refused, means for the message under way. Raises LeagueError."""
        if isinstance(error, InvalidStatus):
            refusal = error.response
            headers = dict(refusal.headers.raw_items())
            return httpx.Response(refusal.status_code, headers=headers, content=bytes(refusal.body or b""))
        if isinstance(error, ConnectionClosed) and error.rcvd is not None and error.rcvd.code in CLOSED_FOR:
            raise CLOSED_FOR[error.rcvd.code](f"{self.url} was closed: {error.rcvd.reason or error}") from error
        return httpx.ReadError(f"the connection was lost: {str(error) or type(error).__name__}")

    def pause(self, attempts: Attempts, outcome: Outcome) -> float | None:
        """Seconds until the message is sent again; None if it was answered. Raises the LeagueError that the outcome
        stands for."""
        if isinstance(outcome, httpx.Response) and outcome.status_code == ANSWERED:
            return None
        if (pause := attempts.pause(outcome)) is not None:
            return pause
        if isinstance(outcome, httpx.Response):
            raise fault(outcome, self.url)
        raise RemoteError(f"{self.url}: {outcome}") from outcome

    def _resumed(self, reset: bool | list[bool]) -> Any:
        """The state to go on from: none where an episode begins."""
        if not isinstance(reset, list) or not isinstance(self._state, list):
            return self._state
        return [None if begins else state for begins, state in zip(reset, self._state, strict=False)]
