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

from evaluation.matches.watchdog import Deadline, GameTimeout, enforce_deadline
from evaluation.matches.worker import MatchWorker
from evaluation.playback.environment_hooks import EnvironmentHooks, environment_hooks
from evaluation.playback.human_play import human_play, playability
from evaluation.playback.recorded_steps import recorded_steps
from evaluation.playback.replay import recorded_game
from evaluation.playback.video import write_video
from league.environments.lockstep import stock_stepping
from league.environments.stepping import BatchedEnvironment
from league.errors import GameCrashed, GameHung, LeagueError, one_line
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
        self._environment: BatchedEnvironment | None = None
        self._hooks: EnvironmentHooks | None = None

    def respond(self, operation: GameOperation) -> GameResponse:
        """Perform an operation. Raises LeagueError. An environment in an undefined state is discarded."""
        matches = self._ready()
        match operation:
            case PlayabilityRequest():
                return _json(playability(matches.config, self._registry, matches.interface, self._shown))
            case VideoRequest():
                return GameResponse("image/gif", self._video(operation))
            case RecordingRequest():
                return _json(self._recording(operation))
            case HumanPlayRequest():
                return _json(self._human_play(operation, matches))

    def discard_environment(self) -> None:
        """Drop the environment without calling it again."""
        self._environment = None

    def _ready(self) -> MatchWorker:
        """Load the current configuration of the league and create its environment."""
        config = self._registry.leagues.get(self._league).config
        try:
            if self._matches is None or self._matches.config != config:
                self._matches, self._environment = MatchWorker(config, self._registry), None
            if self._environment is None:
                self._hooks = environment_hooks(config.environment)
                render_mode = "rgb_array" if self._hooks.draws else None
                self._environment = stock_stepping(config.environment, 1, render_mode=render_mode)
        except Exception as error:  # never a fault of the caller
            raise GameCrashed(f"the environment of {self._league} cannot be created: {one_line(error)}") from error
        return self._matches

    @property
    def _open(self) -> BatchedEnvironment:
        assert self._environment is not None, "_ready creates one"
        return self._environment

    @property
    def _shown(self) -> EnvironmentHooks:
        assert self._hooks is not None, "_ready reads them"
        return self._hooks

    def _recording(self, request: RecordingRequest) -> BaseModel:
        source = recorded_game(request.match, request.game, self._registry, chances=True)
        match = Ledger(self._registry).match(request.match)
        recording = recorded_steps(source, match, request, self._open, self._shown.draws)
        if recording.fault is not None:
            self.discard_environment()
        return recording

    def _video(self, request: VideoRequest) -> bytes:
        source = recorded_game(request.match, request.game, self._registry, chances=True)
        with tempfile.TemporaryDirectory() as directory:
            out = Path(directory) / "game.gif"
            try:
                write_video(source, out)
            except LeagueError:
                raise
            except Exception as error:
                raise GameCrashed(f"{source.title} cannot be rendered: {one_line(error, with_type=True)}") from error
            return out.read_bytes()

    def _human_play(self, request: HumanPlayRequest, matches: MatchWorker) -> BaseModel:
        opponent = acting_ref(request.opponent, self._registry, f"game {request.seed}")
        policies = {agent: policy for agent, (_, policy) in matches.contestant(opponent).items()}
        try:
            return human_play(request, matches.config, matches.interface, policies, self._open, self._shown)
        except GameCrashed:
            self.discard_environment()
            raise


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
        worker.discard_environment()
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

        answer_requests(respond)


if __name__ == "__main__":
    main()
