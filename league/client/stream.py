"""A WebSocket to a policy server, for a client that acts at every tick: one message each way, no request line.

    with client.stream("connect_four") as stream:
        action = stream.act(observation)

It is opened at the first action, and again whenever it is lost: a replica that drains says so (1012), another one
answers. The version stays, and so does an episode's recurrent state.
"""

import asyncio
import time
from collections.abc import Sequence
from contextlib import AsyncExitStack, ExitStack
from types import TracebackType
from typing import Any, Self

from websockets.asyncio.client import ClientConnection as AsyncConnection
from websockets.asyncio.client import connect as connect_async
from websockets.sync.client import ClientConnection, connect

from league.client.answers import Answer, BatchAnswer
from league.client.conversation import LOSSES, Conversation
from league.client.encoding import Encoding
from league.client.endpoint import Endpoint
from league.client.models import Model
from league.client.patience import Attempts, Outcome
from league.client.questions import BatchQuestion, Question

FAREWELL = 1.0
"""Seconds that a server has to say goodbye."""


class _Stream:
    """What both kinds of streams know."""

    def __init__(self, endpoint: Endpoint, model: Model, patience: float, encoding: Encoding, *, follow: bool) -> None:
        self._endpoint = endpoint
        self._patience = patience
        self._encoding: Encoding = encoding
        self._talk = Conversation(endpoint, model, follow)

    @property
    def version(self) -> int | None:
        """The version that answers; None before the stream was opened by an alias."""
        return self._talk.version

    @property
    def last(self) -> Answer | BatchAnswer | None:
        """The last answer, whole; None before the first action."""
        return self._talk.last

    def _question(self, observation: Any, explore: bool, seed: int | None, probabilities: bool) -> Question:
        return Question.about(observation, self._encoding, explore=explore, seed=seed, probabilities=probabilities)

    def _batch(
        self, observations: Any, explore: bool, seed: int | Sequence[int] | None, probabilities: bool
    ) -> BatchQuestion:
        return BatchQuestion.about(
            observations, self._encoding, explore=explore, seed=seed, probabilities=probabilities
        )


class Stream(_Stream):
    """A stream; made by `Client.stream`. Not for several threads at once.

    follow: each action is of the version that the alias (`champion`, or the one that `model` names) points to at that
    moment; else the version that the stream opened with stays.
    """

    def __init__(self, endpoint: Endpoint, model: Model, patience: float, encoding: Encoding, *, follow: bool) -> None:
        super().__init__(endpoint, model, patience, encoding, follow=follow)
        self._connection: ClientConnection | None = None
        self._open_until = ExitStack()

    def act(
        self,
        observation: Any,
        *,
        reset: bool = False,
        explore: bool = False,
        seed: int | None = None,
        probabilities: bool = False,
    ) -> Any:
        """The action for an observation, as the environment takes it. reset: an episode begins with it.

        Raises what `Client.act` does, and VersionRetired if the stream's version is served no more when it must be
        opened again.
        """
        self._ask(self._question(observation, explore, seed, probabilities), reset)
        assert isinstance(self.last, Answer)
        return self.last.action

    def act_batch(
        self,
        observations: Any,
        *,
        reset: bool | Sequence[bool] = False,
        explore: bool = False,
        seed: int | Sequence[int] | None = None,
        probabilities: bool = False,
    ) -> list[Any]:
        """The actions for a batch. reset: episodes begin with all of them, or with those named. See `act`."""
        question = self._batch(observations, explore, seed, probabilities)
        self._ask(question, reset if isinstance(reset, bool) else list(reset))
        assert isinstance(self.last, BatchAnswer)
        return self.last.actions

    def close(self) -> None:
        """Close the connection. Another action would open one anew."""
        self._connection = None
        self._open_until.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _ask(self, question: Question | BatchQuestion, reset: bool | list[bool]) -> None:
        attempts = Attempts(self._patience)
        while (pause := self._talk.pause(attempts, self._attempt(question, reset))) is not None:
            time.sleep(pause)

    def _attempt(self, question: Question | BatchQuestion, reset: bool | list[bool]) -> Outcome:
        try:
            connection = self._connection or self._open()
            connection.send(self._talk.message(question, reset))
            while True:
                outcome = self._talk.read(question, connection.recv(self._endpoint.timeout))
                if outcome is not None:
                    return outcome
        except LOSSES as error:
            # An answer that comes late would be taken for the next one's: a connection is used no more after that.
            self.close()
            return self._talk.lost(error)

    def _open(self) -> ClientConnection:
        opening = connect(
            self._talk.url,
            additional_headers=self._endpoint.headers,
            compression=None,
            open_timeout=self._endpoint.timeout,
            close_timeout=FAREWELL,
            max_size=None,
        )
        connection = self._open_until.enter_context(opening)
        assert connection.response is not None
        self._talk.opened(connection.response.headers)
        self._connection = connection
        return connection


class AsyncStream(_Stream):
    """A stream; made by `AsyncClient.stream`, see `Stream`. One action at a time."""

    def __init__(self, endpoint: Endpoint, model: Model, patience: float, encoding: Encoding, *, follow: bool) -> None:
        super().__init__(endpoint, model, patience, encoding, follow=follow)
        self._connection: AsyncConnection | None = None
        self._open_until = AsyncExitStack()

    async def act(
        self,
        observation: Any,
        *,
        reset: bool = False,
        explore: bool = False,
        seed: int | None = None,
        probabilities: bool = False,
    ) -> Any:
        """See `Stream.act`."""
        await self._ask(self._question(observation, explore, seed, probabilities), reset)
        assert isinstance(self.last, Answer)
        return self.last.action

    async def act_batch(
        self,
        observations: Any,
        *,
        reset: bool | Sequence[bool] = False,
        explore: bool = False,
        seed: int | Sequence[int] | None = None,
        probabilities: bool = False,
    ) -> list[Any]:
        """See `Stream.act_batch`."""
        question = self._batch(observations, explore, seed, probabilities)
        await self._ask(question, reset if isinstance(reset, bool) else list(reset))
        assert isinstance(self.last, BatchAnswer)
        return self.last.actions

    async def close(self) -> None:
        """See `Stream.close`."""
        self._connection = None
        await self._open_until.aclose()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def _ask(self, question: Question | BatchQuestion, reset: bool | list[bool]) -> None:
        attempts = Attempts(self._patience)
        while (pause := self._talk.pause(attempts, await self._attempt(question, reset))) is not None:
            await asyncio.sleep(pause)

    async def _attempt(self, question: Question | BatchQuestion, reset: bool | list[bool]) -> Outcome:
        try:
            async with asyncio.timeout(self._endpoint.timeout):
                connection = self._connection or await self._open()
                await connection.send(self._talk.message(question, reset))
                while True:
                    outcome = self._talk.read(question, await connection.recv())
                    if outcome is not None:
                        return outcome
        except LOSSES as error:
            await self.close()
            return self._talk.lost(error)
        except asyncio.CancelledError:
            await self.close()  # what was asked is still to be answered
            raise

    async def _open(self) -> AsyncConnection:
        opening = connect_async(
            self._talk.url,
            additional_headers=self._endpoint.headers,
            compression=None,
            open_timeout=self._endpoint.timeout,
            close_timeout=FAREWELL,
            max_size=None,
        )
        connection = await self._open_until.enter_async_context(opening)
        assert connection.response is not None
        self._talk.opened(connection.response.headers)
        self._connection = connection
        return connection
