"""Games of one league for people, in a process of their own: shown, filmed, and played with.

    python -m evaluation.stage '{"league": "connect_four", "seconds": 60}'

It says {} on standard output when it is ready. Orders come on standard input, a line of JSON each, and are answered one
after another: a line of JSON, {"media_type", "size"} and then so many bytes, or {"code", "message"}. The process ends
when its input does.

Why a process: an environment is somebody else's code. It may hang, crash the interpreter, or draw with a library that
takes the main thread for granted; and only the main thread can be interrupted by a deadline.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import BinaryIO

from evaluation.children import SOON, step_aside
from evaluation.deadline import Deadline, Expired, watched
from evaluation.film import film, render_modes
from evaluation.player import Player
from evaluation.recordings import leaf_through
from evaluation.report import Document
from evaluation.shows import recorded
from evaluation.sitting import sit
from evaluation.table import table
from league.environments.lockstep import stepping
from league.environments.stepping import BatchedEnvironment
from league.errors import GameCrashed, GameHung, LeagueError
from league.games import Film, Order, Recording, Sitting, Table
from league.policies.policy import Policy
from league.registry.registry import Registry
from league.results.ledger import Ledger
from league.settings import Storage

JSON, GIF = "application/json", "image/gif"

Answer = tuple[str, bytes]
"""(media type, content)"""


class Stage:
    """One environment of a league, and those who play in it. For one thread."""

    def __init__(self, league: str, registry: Registry) -> None:
        self._league, self._registry = league, registry
        self._player: Player | None = None
        self._environment: BatchedEnvironment | None = None
        self._draws = False

    def answer(self, asked: Recording | Film | Table | Sitting) -> Answer:
        """Do what is asked. Raises LeagueError; the environment is not used again if it may be left in disorder."""
        player = self._ready()
        match asked:
            case Table():
                return _json(table(self._league, self._registry, player.interface, self._draws))
            case Film():
                return GIF, self._film(asked)
            case Recording():
                return _json(self._recording(asked))
            case Sitting():
                return _json(self._sitting(asked, player))

    def leave(self) -> None:
        """Forget the environment without another call of it."""
        self._environment = None

    def _ready(self) -> Player:
        """The player of the league as it is registered now, and an environment."""
        config = self._registry.league(self._league).config
        try:
            if self._player is None or self._player.config != config:
                self._player, self._environment = Player(config, self._registry), None
            if self._environment is None:
                self._draws = "rgb_array" in render_modes(config.environment)
                self._environment = stepping(config.environment, 1, render_mode="rgb_array" if self._draws else None)
        except Exception as error:  # whatever the fault is, it is none of who asks
            raise GameCrashed(f"the environment of {self._league} cannot be made: {error}") from error
        return self._player

    @property
    def _open(self) -> BatchedEnvironment:
        assert self._environment is not None, "_ready makes one"
        return self._environment

    def _recording(self, asked: Recording) -> Document:
        show = recorded(asked.match, asked.game, self._registry, chances=True)
        found = leaf_through(show, Ledger(self._registry).match(asked.match), asked, self._open, self._draws)
        if found.fault is not None:
            self.leave()
        return found

    def _film(self, asked: Film) -> bytes:
        show = recorded(asked.match, asked.game, self._registry, chances=True)
        with tempfile.TemporaryDirectory() as directory:
            out = Path(directory) / "game.gif"
            try:
                film(show, out)
            except LeagueError:
                raise
            except Exception as error:
                raise GameCrashed(f"{show.title} cannot be filmed: {type(error).__name__}: {error}") from error
            return out.read_bytes()

    def _sitting(self, asked: Sitting, player: Player) -> Document:
        players: Mapping[str, Policy] = {
            agent: policy for agent, (_, policy) in player.contestant(asked.opponent).items()
        }
        try:
            return sit(asked, player.config, player.interface, players, self._open, self._draws)
        except GameCrashed:
            self.leave()
            raise


def attend(stage: Stage, orders: BinaryIO, answers: BinaryIO, seconds: float) -> None:
    """Answer orders until there are no more. seconds: what one may take.

    What is no LeagueError is a bug of ours, and goes to the log with the end of this process.
    """
    for line in orders:
        try:
            media_type, content = _in_time(stage, Order.model_validate_json(line), seconds)
            head: dict[str, str | int] = {"media_type": media_type, "size": len(content)}
        except LeagueError as error:
            head, content = {"code": error.code, "message": str(error)}, b""
        answers.write(json.dumps(head).encode() + b"\n" + content)
        answers.flush()


def _in_time(stage: Stage, order: Order, seconds: float) -> Answer:
    end = time.monotonic() + seconds

    def look() -> None:
        if time.monotonic() > end:
            raise Expired(GameHung(f"a game of {order.league} was not at its end after {seconds:g} s"))

    try:
        # Where a signal is not minded the studio ends this process; where there is no studio any more, it ends itself.
        with watched(look, Deadline(seconds, expendable=True)):
            return stage.answer(order.asked)
    except Expired as expired:
        stage.leave()
        raise expired.error from None


def _json(document: Document) -> Answer:
    return JSON, json.dumps(document.to_json(), allow_nan=False, separators=(",", ":")).encode()


def main() -> None:
    """Play for the process that holds the other ends of the pipes."""
    given = json.loads(sys.argv[1])
    step_aside(SOON)
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what environments print goes elsewhere
    with closing(Registry.open(Storage.from_environment(), create=False)) as registry:
        answers.write(b"{}\n")
        answers.flush()
        attend(Stage(given["league"], registry), sys.stdin.buffer, answers, given["seconds"])


if __name__ == "__main__":
    main()
