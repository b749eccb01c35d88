"""The studio as replicas see it: another deployment of the same application, called by handle, which plays games."""

import asyncio
from typing import NamedTuple, Protocol

from ray.exceptions import RayError, RayTaskError
from ray.serve.exceptions import RayServeException
from ray.serve.handle import DeploymentHandle

from league.errors import BY_CODE, NoStudio
from league.games import Order

PATIENCE, LATEST = 0.7, 0.9
"""Shares of the time that a request has: for the studio to answer, and to be heard of at all."""


class Answer(NamedTuple):
    """What the studio made, as it goes to whoever asked."""

    media_type: str
    content: bytes


class Studio(Protocol):
    """What may be asked of it."""

    def look(self) -> None:
        """There is something new in the registry. Waits for nobody: the studio looks now and then by itself."""

    async def ask(self, order: Order) -> Answer:
        """Show a game, or play one. Raises NoStudio if it cannot be reached, else the LeagueError that it tells:
        NotReady where it takes longer than a request can wait, and goes on."""


class StudioHandle:
    """The studio behind Ray Serve's handle. timeout: seconds that a request has."""

    def __init__(self, handle: DeploymentHandle, timeout: float) -> None:
        self._handle, self._timeout = handle, timeout

    def look(self) -> None:
        """Tell it. If it is not there just now, it will see what there is when it is."""
        self._handle.look.remote()

    async def ask(self, order: Order) -> Answer:
        """Errors come as data: raised over there, they would arrive with a traceback for a message."""
        try:
            async with asyncio.timeout(LATEST * self._timeout):
                told = await self._handle.ask.remote(order.model_dump_json(), PATIENCE * self._timeout)
        except RayTaskError:
            raise  # a bug of ours over there
        except (RayError, RayServeException, TimeoutError) as error:
            raise NoStudio("the studio, which plays games, does not answer: it may be starting") from error
        if "code" in told:
            raise BY_CODE[told["code"]](told["message"])
        return Answer(**told)
