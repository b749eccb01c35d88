"""Client of the evaluation service, a separate deployment of the same application that is called by handle."""

import asyncio
from contextlib import suppress
from typing import Protocol

from ray.exceptions import RayError, RayTaskError
from ray.serve.exceptions import RayServeException
from ray.serve.handle import DeploymentHandle

from league.errors import NoEvaluationService, from_document
from league.service_requests import GameRequest, GameResponse

SERVICE_SHARE, CALL_SHARE = 0.7, 0.9
"""Shares of the request timeout: for the evaluation service to respond, and for the whole call."""


class EvaluationClient(Protocol):
    """What routes call."""

    def notify(self) -> None:
        """Report a change in the registry, without waiting. This starts the evaluation service, which ends by itself
        when there is nothing to do.
        """

    async def request_game(self, request: GameRequest) -> GameResponse:
        """Show a game or continue one.

        Raises:
            NoEvaluationService: The evaluation service is unreachable.
            NotReady: The response takes longer than a request can wait. Its computation continues.
            LeagueError: The error that the evaluation service reported.
        """


def require_client(client: EvaluationClient | None) -> EvaluationClient:
    """Return the client of a server. Raises NoEvaluationService if it has none."""
    if client is None:
        raise NoEvaluationService(
            "this server has no evaluation service: `evaluation_service` is not set in its deploy.yaml"
        )
    return client


class ServeEvaluationClient:
    """Calls the evaluation service through its Ray Serve handle.

    Args:
        handle: Handle of the deployment.
        timeout: Time limit of an HTTP request, in seconds.
    """

    def __init__(self, handle: DeploymentHandle, timeout: float) -> None:
        self._handle, self._timeout = handle, timeout
        self._work: asyncio.Task[None] | None = None

    def notify(self) -> None:
        """Report a change. If the service is down, it finds the change after its start."""
        self._handle.notify.remote()
        self._let_work()

    def _let_work(self) -> None:
        """Call `work`, unless such a call is in progress. Ray Serve runs the service meanwhile."""
        if self._work is None or self._work.done():
            self._work = asyncio.create_task(self._call_work())

    async def _call_work(self) -> None:
        with suppress(RayError, RayServeException):  # it has ended: the next call starts it again
            await self._handle.work.remote()

    async def request_game(self, request: GameRequest) -> GameResponse:
        """Send a request. Errors return as data, because exceptions would arrive with a traceback as their message."""
        self._let_work()
        try:
            async with asyncio.timeout(CALL_SHARE * self._timeout):
                response = await self._handle.request_game.remote(
                    request.model_dump_json(), SERVICE_SHARE * self._timeout
                )
        except RayTaskError:
            raise  # a bug in the evaluation service
        except (RayError, RayServeException, TimeoutError) as error:
            raise NoEvaluationService("the evaluation service does not respond: it may be starting") from error
        if "code" in response:
            raise from_document(response)
        return GameResponse(**response)
