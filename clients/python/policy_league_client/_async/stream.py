"""WebSocket streams for programs that need an action at every tick: one message in each direction per action.

A stream connects at the first action and reconnects whenever the connection is lost, for example because its replica
shuts down (close code 1012). Its version and its recurrent state survive a reconnection.
"""

from collections.abc import Sequence
from typing import Any, Self

from policy_league_client.endpoint import Endpoint
from policy_league_client.requests import ActionRequest, BatchActionRequest, Encoding
from policy_league_client.responses import ActionResponse, BatchActionResponse, Model
from policy_league_client.retries import Outcome, Retries
from policy_league_client.stream_protocol import CONNECTION_ERRORS, StreamProtocol
from policy_league_client.transport import (
    AsyncCancelled,
    AsyncConnection,
    async_connect,
    async_receive,
    async_sleep,
    async_time_limit,
)


class AsyncStream:
    """A WebSocket stream, created by `AsyncClient.stream`. Do not share it between threads or tasks.

    Args:
        endpoint: The server.
        model: The policy, with or without a version.
        retry_deadline: Seconds within which a message is sent again after a temporary failure.
        encoding: Encoding of arrays.
        follow: Each action comes from the version that the alias of `model` (default: `champion`) points to at that
            moment. Otherwise the version with which the stream opened answers every message.
    """

    def __init__(
        self, endpoint: Endpoint, model: Model, retry_deadline: float, encoding: Encoding, *, follow: bool
    ) -> None:
        self._endpoint = endpoint
        self._retry_deadline = retry_deadline
        self._encoding: Encoding = encoding
        self._protocol = StreamProtocol(endpoint, model, follow)
        self._connection: AsyncConnection | None = None

    @property
    def version(self) -> int | None:
        """The version that answers; None before the first action if `model` has no version number."""
        return self._protocol.version

    @property
    def last(self) -> ActionResponse | BatchActionResponse | None:
        """The last response; None before the first action."""
        return self._protocol.last

    async def act(
        self,
        observation: Any,
        *,
        reset: bool = False,
        explore: bool | None = None,
        seed: int | None = None,
        probabilities: bool = False,
        deadline_ms: int | None = None,
        analysis: bool = False,
    ) -> Any:
        """Request the action for one observation.

        Args:
            observation: See `AsyncClient.act`.
            reset: Start an episode with this observation: the recurrent state is reset.
            explore: See `AsyncClient.act`.
            seed: See `AsyncClient.act`.
            probabilities: Include the action probabilities in the response, which is available as `last`.
            deadline_ms: See `AsyncClient.act`.
            analysis: See `AsyncClient.act`. It is in the response, `last`.

        Returns:
            The action in the environment's format: an int or an array (float32 or int64).

        Raises:
            VersionRetired: The stream had to reconnect, and its version is not served any more.
            LeagueError: See `AsyncClient`.
        """
        request = ActionRequest.build(
            observation,
            self._encoding,
            explore=explore,
            seed=seed,
            probabilities=probabilities,
            deadline_ms=deadline_ms,
            analysis=analysis,
        )
        await self._send(request, reset)
        assert isinstance(self.last, ActionResponse)
        return self.last.action

    async def act_batch(
        self,
        observations: Any,
        *,
        reset: bool | Sequence[bool] = False,
        explore: bool | None = None,
        seed: int | Sequence[int] | None = None,
        probabilities: bool = False,
        deadline_ms: int | None = None,
        analysis: bool = False,
    ) -> list[Any]:
        """Request the actions for a batch of observations.

        Args:
            observations: See `AsyncClient.act_batch`.
            reset: Start an episode in every row, or in the rows that are True.
            explore: See `AsyncClient.act`.
            seed: One seed for the batch, or one for each observation.
            probabilities: See `act`.
            deadline_ms: See `act`.
            analysis: See `act`.

        Returns:
            The actions, in the order of the observations.

        Raises:
            LeagueError: See `act`.
        """
        request = BatchActionRequest.build(
            observations,
            self._encoding,
            explore=explore,
            seed=seed,
            probabilities=probabilities,
            deadline_ms=deadline_ms,
            analysis=analysis,
        )
        await self._send(request, reset if isinstance(reset, bool) else list(reset))
        assert isinstance(self.last, BatchActionResponse)
        return self.last.actions

    async def close(self) -> None:
        """Close the connection. The next action opens a new one."""
        connection, self._connection = self._connection, None
        if connection is not None:
            await connection.close()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def _send(self, request: ActionRequest | BatchActionRequest, reset: bool | list[bool]) -> None:
        retries = Retries(self._retry_deadline)
        while (delay := self._protocol.next_delay(retries, await self._attempt(request, reset))) is not None:
            await async_sleep(delay)

    async def _attempt(self, request: ActionRequest | BatchActionRequest, reset: bool | list[bool]) -> Outcome:
        timeout = self._endpoint.timeout
        try:
            async with async_time_limit(timeout):
                connection = self._connection or await self._open()
                await connection.send(self._protocol.message(request, reset))
                while True:
                    outcome = self._protocol.receive(request, await async_receive(connection, timeout))
                    if outcome is not None:
                        return outcome
        except CONNECTION_ERRORS as error:
            # On the same connection, a late response would be taken for the response to the next message.
            await self.close()
            return self._protocol.connection_lost(error)
        except AsyncCancelled:
            await self.close()  # for the same reason
            raise

    async def _open(self) -> AsyncConnection:
        self._connection = await async_connect(self._protocol.url, self._endpoint.headers, self._endpoint.timeout)
        assert self._connection.response is not None
        self._protocol.opened(self._connection.response.headers)
        return self._connection
