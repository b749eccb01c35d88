"""The processes that show games to people and play with them: one for each league that somebody looks at.

    Stages.ask → the league's thread → pipe → evaluation.stage

Each has a thread, in which its orders wait for one another: an environment is for one game at a time. One that hangs
takes its own league's orders with it, until its deadline, and nobody else's. What was answered is kept for a while, so
that an order which takes longer than a request can wait is simply asked for again.
"""

from __future__ import annotations

import asyncio
import json
import subprocess
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

from evaluation import children
from league.errors import BY_CODE, GameHung, LeagueError, NotReady, Overloaded, WorkerLost
from league.games import Order

T = TypeVar("T")

SECONDS = 60.0
"""What one order may take: a film of hundreds of frames takes half of it."""
GRACE = 5.0
"""Seconds more, after which a process that has not given up by itself is ended."""
START = 60.0
"""Seconds in which a process must be ready."""
MOST_STAGES = 4
"""Leagues at a time; that of which nobody has asked anything for longest makes way for another."""
MOST_WAITING = 16
"""Orders of one league that are not answered yet."""
MOST_KEPT, ROOM = 256, 64 * 2**20
"""Answers that are kept, and their bytes."""


@dataclass(frozen=True, slots=True)
class Answer:
    """What an order brought."""

    media_type: str
    content: bytes


class Stages:
    """Asked from one event loop."""

    def __init__(self, seconds: float = SECONDS, grace: float = GRACE, most: int = MOST_STAGES) -> None:
        self._seconds, self._grace, self._most = seconds, grace, most
        self._stages: OrderedDict[str, _Stage] = OrderedDict()
        self._known: OrderedDict[str, Future[Answer]] = OrderedDict()

    async def ask(self, order: Order, patience: float) -> Answer:
        """The answer to an order, if it comes within `patience` seconds; else it goes on, and may be asked for again.

        Raises NotReady then, Overloaded where too much waits, GameHung, WorkerLost if the process died, and whatever
        LeagueError it told.
        """
        line = order.model_dump_json()
        answer = self._known.get(line)
        if answer is None or (answer.done() and not order.has_one_answer):
            answer = self._known[line] = self._stage(order.league).play(line)
        self._known.move_to_end(line)
        self._trim()
        try:
            return await asyncio.wait_for(asyncio.shield(asyncio.wrap_future(answer)), patience)
        except TimeoutError:
            raise NotReady(f"a game of {order.league} is still being played: ask again") from None
        except LeagueError:
            if self._known.get(line) is answer:
                del self._known[line]  # told once: the next time it may be otherwise
            raise

    def close(self) -> None:
        """End all processes."""
        while self._stages:
            self._stages.popitem()[1].close()

    def _stage(self, league: str) -> _Stage:
        if league not in self._stages:
            self._make_room()
            self._stages[league] = _Stage(league, self._seconds, self._grace)
        self._stages.move_to_end(league)
        return self._stages[league]

    def _make_room(self) -> None:
        if len(self._stages) < self._most:
            return
        idle = next((league for league, stage in self._stages.items() if not stage.is_busy), None)
        if idle is None:
            raise Overloaded(f"games of {len(self._stages)} other leagues are being played: come back soon")
        self._stages.pop(idle).close()

    def _trim(self) -> None:
        """Forget the oldest answers beyond what is kept."""
        sizes = {line: _size(answer) for line, answer in self._known.items() if answer.done()}
        over, room = len(self._known) - MOST_KEPT, ROOM - sum(sizes.values())
        for line, size in sizes.items():
            if over <= 0 and room >= 0:
                return
            del self._known[line]
            over, room = over - 1, room + size


class _Stage:
    """One process, started when something is asked of it, and again when it has died; its thread talks with it."""

    def __init__(self, league: str, seconds: float, grace: float) -> None:
        self._league, self._seconds, self._grace = league, seconds, grace
        self._thread = ThreadPoolExecutor(1, f"stage-{league}")
        self._asked: list[Future[Answer]] = []
        self._process: subprocess.Popen[bytes] | None = None
        self._is_closed = False

    @property
    def is_busy(self) -> bool:
        """Whether something is asked that it has not answered."""
        return any(not asked.done() for asked in self._asked)

    def play(self, line: str) -> Future[Answer]:
        """Answer an order when those before it are answered. Raises Overloaded."""
        self._asked = [asked for asked in self._asked if not asked.done()]
        if len(self._asked) >= MOST_WAITING:
            raise Overloaded(f"{len(self._asked)} games of {self._league} wait to be played: come back soon")
        self._asked.append(self._thread.submit(self._play, line))
        return self._asked[-1]

    def close(self) -> None:
        """End the process."""
        self._is_closed = True
        self._thread.shutdown(wait=False, cancel_futures=True)
        if self._process is not None:
            _end(self._process)

    def _play(self, line: str) -> Answer:
        is_old = self._process is not None
        try:
            return self._try(line)
        except WorkerLost:
            if not is_old:
                raise
            return self._try(line)  # it may have died of something before, or of somebody

    def _try(self, line: str) -> Answer:
        if self._process is None:
            given = {"league": self._league, "seconds": self._seconds}
            self._process = children.start("evaluation.stage", json.dumps(given), answers=True)
            if self._is_closed:
                self._process.kill()
            self._within(START, self._process, _greeted)
        return self._within(self._seconds + self._grace, self._process, lambda process: _talk(process, line))

    def _within(
        self, seconds: float, process: subprocess.Popen[bytes], talk: Callable[[subprocess.Popen[bytes]], T]
    ) -> T:
        """What comes of a talk with a process, which is ended if that takes longer."""
        began, overdue = time.monotonic(), threading.Timer(seconds, process.kill)
        overdue.start()
        try:
            return talk(process)
        except (OSError, ValueError) as error:
            _end(process)
            self._process = None
            if time.monotonic() - began >= seconds:
                raise GameHung(f"a game of {self._league} hung: its process was ended after {seconds:g} s") from error
            raise WorkerLost(f"the process that plays games of {self._league} died: its log says why") from error
        finally:
            overdue.cancel()


def _greeted(process: subprocess.Popen[bytes]) -> None:
    """Raises ValueError if the process has died instead of saying that it is ready."""
    assert process.stdout is not None
    json.loads(process.stdout.readline())


def _talk(process: subprocess.Popen[bytes], line: str) -> Answer:
    """Raises the error that the process told, and OSError or ValueError if it has died."""
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write(line.encode() + b"\n")
    process.stdin.flush()
    head = json.loads(process.stdout.readline())
    if "code" in head:
        raise BY_CODE[head["code"]](head["message"])
    content = process.stdout.read(head["size"])
    if len(content) < head["size"]:
        raise ValueError("the answer is cut off")
    return Answer(head["media_type"], content)


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    children.bury(process)


def _size(answer: Future[Answer]) -> int:
    return 0 if answer.exception() else len(answer.result().content)
