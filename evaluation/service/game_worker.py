"""Worker process for the games of one league that people watch or play.

    python -m evaluation.service.game_worker '{"league": "connect_four", "seconds": 60}'

Requests are GameRequests in JSON. A response has the `media_type` of its content; see
`league.subprocesses.answer_requests`.

It is a separate process because an environment is third-party code: it may hang, crash the interpreter or require the
main thread for rendering, and a deadline can interrupt the main thread only.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path

import orjson
from pydantic import BaseModel

from evaluation.matches.watchdog import Deadline, GameTimeout, close_in_time, enforce_deadline
from evaluation.matches.worker import MatchWorker
from evaluation.playback.environment_hooks import EnvironmentHooks, environment_hooks
from evaluation.playback.human_play import human_play, playability
from evaluation.playback.recorded_steps import recorded_steps
from evaluation.playback.replay import GameSource, recorded_game
from evaluation.playback.video import write_video
from league.environments.implementation import stock_stepping
from league.environments.stepping import BatchedEnvironment
from league.errors import EnvironmentMismatch, GameCrashed, GameHung, LeagueError, one_line
from league.policies.loading import acting_ref
from league.registry.registry import Registry
from league.results.ledger import Ledger
from league.service_requests import (
    GameOperation,
    GameRequest,
    GameResponse,
    HumanPlayRequest,
    PlayabilityRequest,
    RecordingRequest,
    VideoRequest,
)
from league.settings import Storage
from league.subprocesses import INTERACTIVE, answer_requests, lower_priority


class GameWorker:
    """One environment of a league with the loaded policies. Not thread-safe."""

    def __init__(self, league: str, registry: Registry) -> None:
        self._league, self._registry = league, registry
        self._matches: MatchWorker | None = None
        self._stage: tuple[BatchedEnvironment, EnvironmentHooks] | None = None

    def respond(self, operation: GameOperation) -> GameResponse:
        """Perform an operation. Raises LeagueError. An environment in an undefined state is closed."""
        matches, environment, hooks = self._ready()
        match operation:
            case PlayabilityRequest():
                return _json(playability(matches.config, self._registry, matches.interface, hooks))
            case VideoRequest():
                source = recorded_game(operation.match, operation.game, self._registry, chances=True)
                return GameResponse("image/gif", _video(source))
            case RecordingRequest():
                record = Ledger(self._registry).match(operation.match)
                source = recorded_game(operation.match, operation.game, self._registry, chances=True, request=operation)
                recording = recorded_steps(source, record, operation, environment, hooks.draws)
                if recording.fault is not None:
                    self.close()
                return _json(recording)
            case HumanPlayRequest():
                opponent = acting_ref(operation.opponent, self._registry, f"game {operation.seed}")
                policies = {agent: policy for agent, (_, policy) in matches.contestant(opponent).items()}
                analyst = None
                if operation.analysis is not None:
                    players = matches.contestant(f"{self._league}@{operation.analysis}")
                    analyst = players[operation.agent][1] if operation.agent in players else None
                elif operation.chances:
                    analyst = policies.get(operation.agent)
                config, interface = matches.config, matches.interface
                try:
                    return _json(human_play(operation, config, interface, policies, analyst, environment, hooks))
                except GameCrashed:
                    self.close()
                    raise

    def close(self) -> None:
        """Close the environment. The next operation creates another one."""
        stage, self._stage = self._stage, None
        if stage is not None:
            close_in_time(stage[0])

    def _ready(self) -> tuple[MatchWorker, BatchedEnvironment, EnvironmentHooks]:
        """Load the current configuration of the league and create its environment."""
        config = self._registry.leagues.get(self._league).config
        try:
            if self._matches is None or self._matches.config != config:
                self.close()
                self._matches = MatchWorker(config, self._registry)
            if self._stage is None:
                hooks = environment_hooks(config.environment)
                render_mode = "rgb_array" if hooks.draws else None
                self._stage = stock_stepping(config.environment, 1, render_mode=render_mode), hooks
        except Exception as error:  # never a fault of the caller
            if config.environment.external is not None and isinstance(error, EnvironmentMismatch):
                raise  # it says that the game cannot be shown
            raise GameCrashed(f"the environment of {self._league} cannot be created: {one_line(error)}") from error
        return self._matches, *self._stage


def _video(source: GameSource) -> bytes:
    with tempfile.TemporaryDirectory() as directory:
        out = Path(directory) / "game.gif"
        try:
            write_video(source, out)
        except LeagueError:
            raise
        except Exception as error:
            raise GameCrashed(f"{source.title} cannot be rendered: {one_line(error, with_type=True)}") from error
        return out.read_bytes()


def _within(worker: GameWorker, request: GameRequest, seconds: float) -> GameResponse:
    end = time.monotonic() + seconds

    def check() -> None:
        if time.monotonic() > end:
            raise GameTimeout(GameHung(f"a game of {request.league} did not end within {seconds:g} s"))

    try:
        # If the signal has no effect, the pool kills this process. Without a pool, the process ends itself.
        with enforce_deadline(check, Deadline(seconds, expendable=True)):
            return worker.respond(request.operation)
    except GameTimeout as exceeded:
        worker.close()
        raise exceeded.error from None


def _json(document: BaseModel) -> GameResponse:
    return GameResponse("application/json", orjson.dumps(document.model_dump()))


def main() -> None:
    """Respond to the requests of the evaluation service."""
    options = json.loads(sys.argv[1])
    lower_priority(INTERACTIVE)
    with closing(Registry.open(Storage.from_environment(), create=False)) as registry:
        worker = GameWorker(options["league"], registry)

        def respond(request: bytes) -> tuple[Mapping[str, str], bytes]:
            response = _within(worker, GameRequest.model_validate_json(request), options["seconds"])
            return {"media_type": response.media_type}, response.content

        answer_requests(respond, worker.close)


if __name__ == "__main__":
    main()
