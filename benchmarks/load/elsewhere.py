"""Load generators run in processes of their own, so that they share no interpreter with what they measure."""

import asyncio
import threading
from collections.abc import Callable, Coroutine, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any, Generic, TypeVar

Result = TypeVar("Result")
SPAWN = get_context("spawn")


def run_elsewhere(function: Callable[..., Coroutine[Any, Any, Result]], *arguments: object) -> Result:
    """Run a coroutine function in a process of its own, on uvloop, and return its result."""
    with ProcessPoolExecutor(1, mp_context=SPAWN) as pool:
        return pool.submit(_run, function, arguments).result()


def _run(function: Callable[..., Coroutine[Any, Any, Result]], arguments: tuple[object, ...]) -> Result:
    import uvloop

    return uvloop.run(function(*arguments))


class Stage:
    """What a generator that runs until it is stopped sees of the process that has started it.

    on_message: called, in another thread, with what that process sends.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._over = threading.Event()
        self.on_message: Callable[[Any], None] = lambda _: None
        threading.Thread(target=self._receive, daemon=True).start()

    @property
    def is_over(self) -> bool:
        """Whether the generator should end."""
        return self._over.is_set()

    async def over(self) -> None:
        """Return when the generator should end."""
        await asyncio.to_thread(self._over.wait)

    def ready(self) -> None:
        """Say that the generator is at work."""
        self._connection.send(None)

    def _receive(self) -> None:
        with suppress(EOFError):
            while (message := self._connection.recv()) is not None:
                self.on_message(message)
        self._over.set()


class Performance(Generic[Result]):
    """A generator at work. result: available once it has ended."""

    result: Result

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def send(self, message: object) -> None:
        """Pass a message to the generator, which must not be None."""
        self._connection.send(message)


@contextmanager
def beside(function: Callable[..., Coroutine[Any, Any, Result]], *arguments: object) -> Iterator[Performance[Result]]:
    """Run a coroutine function in a process of its own while the context is active, which begins when it is ready.

    function: called with a `Stage` and the arguments. Raises EOFError if it ends before it is ready.
    """
    connection, other = SPAWN.Pipe()
    process = SPAWN.Process(target=_perform, args=(other, function, arguments))
    process.start()
    other.close()
    performance = Performance[Result](connection)
    try:
        connection.recv()
        yield performance
        connection.send(None)
        performance.result = connection.recv()
    finally:
        connection.close()
        process.join(10)
        process.kill()


def _perform(
    connection: Connection, function: Callable[..., Coroutine[Any, Any, object]], arguments: tuple[object, ...]
) -> None:
    connection.send(_run(function, (Stage(connection), *arguments)))
