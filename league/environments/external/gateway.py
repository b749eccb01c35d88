"""A gateway: the WebSocket server of a process that needs episodes, to which simulators connect.

It runs in a thread of its own. What simulators send is decoded and checked there, and waits in a queue.
"""

import asyncio
import hmac
import logging
import secrets
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from http import HTTPStatus
from itertools import count
from queue import SimpleQueue
from time import perf_counter

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.protocol import State
from websockets.typing import Subprotocol

from league.config.external import ExternalConfig
from league.environments.external.messages import (
    MAX_MESSAGE,
    Abandoned,
    Hello,
    MessageCodec,
    Reports,
    refusal,
)
from league.errors import EnvironmentMismatch, LeagueError, one_line

logger = logging.getLogger(__name__)

LOOPBACK = "127.0.0.1"
MAX_CONNECTIONS = 1000
HELLO_SECONDS = 10.0
"""Time for the first message of a simulator."""
PING_SECONDS = 20.0
"""A simulator that does not answer a ping within this time is lost."""
MAX_BACKLOG = MAX_MESSAGE
"""Bytes of a simulator's messages that wait in the queue, unless one alone is larger. More is not read from it."""
BACKLOG_CHECK = 0.002
"""Seconds between two looks at the queue of a simulator that has sent too much."""
INVALID, GOING_AWAY = 1007, 1012
"""Close codes of a simulator that is refused, and of one that is to connect again."""
SUBPROTOCOL, KEY_PREFIX = "policy-league", "policy-league.key."
"""How a page in a browser sends a key: a WebSocket there has no headers."""


@dataclass(eq=False)
class SimulatorLink:
    """A connected simulator.

    Attributes:
        number: Distinguishes the simulators of a gateway.
        hello: What it said about itself.
        seconds: Time between the newest message that was sent to it and its answer.
        sent_at: When it was last sent anything.
    """

    number: int
    hello: Hello
    connection: ServerConnection
    outbox: asyncio.Queue[str | bytes]
    seconds: float = 0.0
    sent_at: float = 0.0
    playing: set[int] = field(default_factory=set)
    """Environments with its episodes."""
    backlog: int = 0
    """Bytes in the queue."""
    abandoned: int = 0
    """Consecutive episodes that it has abandoned."""
    is_leaving: bool = False
    """Whether it gets no more episodes."""

    @property
    def has_room(self) -> bool:
        """Whether it can play one more episode."""
        return len(self.playing) < self.hello.episodes and not self.is_leaving


@dataclass(frozen=True, slots=True)
class Arrival:
    """What a simulator has sent: its first message, once it is connected; later ones; why its connection has ended."""

    link: SimulatorLink
    message: Hello | Reports | Abandoned | str
    size: int = 0
    """Bytes of a later message."""


class GatewayServer:
    """Accepts the simulators of a league on a port of this machine.

    Attributes:
        arrivals: What has happened, in order.
        token: The key that simulators send.
        url: The address to which they connect.
        simulators: Number of simulators that are connected.
    """

    def __init__(self, config: ExternalConfig, codec: MessageCodec, league: str) -> None:
        """Start the thread, and wait until the port is open."""
        self._config, self._codec, self._league = config, codec, league
        self._welcome = codec.welcome(league).decode()
        self.arrivals: SimpleQueue[Arrival] = SimpleQueue()
        self.token = secrets.token_urlsafe(24)
        self._numbers = count(1)
        self._connections = self.simulators = 0
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="gateway", daemon=True)
        self._thread.start()
        self._server: Server = asyncio.run_coroutine_threadsafe(self._serve(), self._loop).result()
        port = self._server.sockets[0].getsockname()[1]
        self.url = f"http://{LOOPBACK}:{port}"

    def send(self, messages: Sequence[tuple[SimulatorLink, str | bytes]]) -> None:
        """Send messages, each to a simulator. Those to lost ones are dropped."""
        if messages:
            self._loop.call_soon_threadsafe(self._put, messages)

    def refuse(self, link: SimulatorLink, error: LeagueError) -> None:
        """End the connection of a simulator that has sent something invalid."""
        asyncio.run_coroutine_threadsafe(self._refuse(link.number, link.connection, error), self._loop)

    def dismiss(self, link: SimulatorLink, reason: str) -> None:
        """End the connection of a simulator, which connects again."""
        asyncio.run_coroutine_threadsafe(link.connection.close(GOING_AWAY, reason), self._loop)

    def dismiss_all(self) -> None:
        """End the connections of all simulators, which connect to whatever needs them."""

        async def dismiss() -> None:
            await asyncio.gather(
                *(connection.close(GOING_AWAY, "no more episodes") for connection in self._server.connections)
            )

        asyncio.run_coroutine_threadsafe(dismiss(), self._loop)

    def close(self) -> None:
        """End all connections; simulators connect again to whatever waits for them then."""

        async def stop() -> None:
            self._server.close(code=GOING_AWAY, reason="no more episodes")
            await self._server.wait_closed()

        asyncio.run_coroutine_threadsafe(stop(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _serve(self) -> Server:
        return await serve(
            self._handle,
            LOOPBACK,
            0,
            process_request=self._authenticate,
            select_subprotocol=lambda _, offered: Subprotocol(SUBPROTOCOL) if SUBPROTOCOL in offered else None,
            compression=None,
            max_size=MAX_MESSAGE,
            max_queue=2,
            ping_interval=PING_SECONDS,
            ping_timeout=PING_SECONDS,
            close_timeout=1.0,
        )

    def _authenticate(self, connection: ServerConnection, request: Request) -> Response | None:
        keys = [value.removeprefix("Bearer ") for value in request.headers.get_all("Authorization")]
        for offered in request.headers.get_all("Sec-WebSocket-Protocol"):
            keys += [part.strip().removeprefix(KEY_PREFIX) for part in offered.split(",")]
        if not any(hmac.compare_digest(key.encode(errors="replace"), self.token.encode()) for key in keys[:8]):
            return connection.respond(HTTPStatus.UNAUTHORIZED, "the token of the run is missing or wrong\n")
        if self._connections >= MAX_CONNECTIONS:
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, "too many simulators are connected\n")
        return None

    async def _handle(self, connection: ServerConnection) -> None:
        number = next(self._numbers)
        self._connections += 1
        try:
            async with asyncio.timeout(HELLO_SECONDS):
                hello = self._codec.hello(await connection.recv())
            expected = self._config.simulator, self._config.version
            if (hello.name, hello.version) != expected:
                raise EnvironmentMismatch(
                    f"simulator {hello.name[:64]!r} of version {hello.version[:64]!r} connects to league"
                    f" {self._league}, which expects {expected[0]!r} of version {expected[1]!r} (environment.external)"
                )
            await connection.send(self._welcome)
            await self._exchange(SimulatorLink(number, hello, connection, asyncio.Queue()))
        except LeagueError as error:
            await self._refuse(number, connection, error)
        except (ConnectionClosed, TimeoutError):
            pass
        finally:
            self._connections -= 1

    async def _exchange(self, link: SimulatorLink) -> None:
        """Pass messages on in both directions, until the connection ends. Raises LeagueError for an invalid one."""
        self.simulators += 1
        writer = asyncio.create_task(self._write(link))
        self.arrivals.put(Arrival(link, link.hello))
        reason = "the connection was lost"
        try:
            await self._read(link)
        except LeagueError as error:
            reason = one_line(error)
            raise
        except ConnectionClosed as closed:
            if closed.rcvd is not None:
                reason = f"the simulator closed the connection: {closed.rcvd.code} {closed.rcvd.reason}".rstrip()
        finally:
            self.simulators -= 1
            writer.cancel()
            self.arrivals.put(Arrival(link, reason))

    async def _read(self, link: SimulatorLink) -> None:
        while True:
            message = await link.connection.recv()
            while link.backlog and link.backlog + len(message) > MAX_BACKLOG:
                if link.connection.state is not State.OPEN:
                    return
                await asyncio.sleep(BACKLOG_CHECK)
            received = self._codec.read(message, link.hello.episodes)
            # Images may be a thousand times larger than their encoding.
            size = max(len(message), received.nbytes)
            link.backlog += size
            self.arrivals.put(Arrival(link, received, size))

    async def _write(self, link: SimulatorLink) -> None:
        try:
            while True:
                await link.connection.send(await link.outbox.get())
        except ConnectionClosed:
            pass

    async def _refuse(self, number: int, connection: ServerConnection, error: LeagueError) -> None:
        logger.warning("Simulator %d (%s) is refused: %s", number, connection.remote_address, one_line(error))
        try:
            async with asyncio.timeout(1.0):
                await connection.send(refusal(error))
        except (ConnectionClosed, TimeoutError):
            pass
        await connection.close(INVALID, str(error).encode()[:120].decode(errors="ignore"))

    def _put(self, messages: Sequence[tuple[SimulatorLink, str | bytes]]) -> None:
        sent_at = perf_counter()
        for link, message in messages:
            link.sent_at = sent_at
            link.outbox.put_nowait(message)
