"""Recorded games as JSON documents: steps with images, players and outcome."""

from __future__ import annotations

from collections.abc import Mapping

from evaluation.playback.action_names import action_names
from evaluation.playback.captions import chances
from evaluation.playback.replay import GameSource
from evaluation.playback.single_game import GameStep, Move
from evaluation.playback.video import data_uri
from league.environments.stepping import BatchedEnvironment
from league.errors import one_line
from league.interface import Interface
from league.results.records import Match
from league.service_requests import (
    MOST_CHANCES,
    Chances,
    GameForfeit,
    RecordedGame,
    RecordedMove,
    RecordedStep,
    RecordingRequest,
)
from league.spaces import Space

LARGEST = 480
"""Longer side of an image, in pixels."""


def step_of(
    step: GameStep, controllers: Mapping[str, str], interface: Interface, picture: str | None = None, opening: int = 0
) -> RecordedStep:
    """The document of a step. controllers: agent → who controls it. opening: number of random steps."""
    moves = tuple(
        RecordedMove(
            agent=move.agent,
            ref=controllers[move.agent],
            action=move.action,
            chances=likely(move, interface.agents[move.agent].action),
            value=move.value,
        )
        for move in step.moves
    )
    return RecordedStep(step=step.step, moves=moves, picture=picture, opening=0 < step.step <= opening)


def likely(move: Move, space: Space) -> Chances:
    """Action probabilities of a move."""
    return tuple((action, round(chance, 6)) for action, chance in chances(move, space, MOST_CHANCES) if chance > 0)


def recorded_steps(
    source: GameSource, match: Match, request: RecordingRequest, environment: BatchedEnvironment, draws: bool
) -> RecordedGame:
    """The requested steps. The game is always replayed to its end, which verifies it.

    match: the record. draws: whether `environment`, with `num_envs` 1, renders images.
    """
    steps: list[RecordedStep] = []
    last: GameStep | None = None
    fault = None
    try:
        for last in source.play(environment):
            if request.includes(last.step, last.is_over):
                picture = data_uri(environment.render(0), LARGEST) if draws else None
                steps.append(step_of(last, source.controllers, source.interface, picture, source.opening))
        assert last is not None, "a game has at least one step"
    except Exception as error:  # third-party code can raise anything
        steps, last = [], None
        fault = one_line(error)
    return RecordedGame(
        match=match.id,
        game=request.game,
        players=dict(source.controllers),
        action_names=action_names(source.config.play, source.interface),
        length=0 if last is None else last.step,
        every=request.every,
        steps=tuple(steps),
        returns={} if last is None else last.returns,
        forfeits=_forfeits(match, request.game),
        fault=fault,
    )


def _forfeits(match: Match, game: int) -> tuple[GameForfeit, ...]:
    return tuple(
        GameForfeit(agent=forfeit.agent, ref=match.contestants[forfeit.contestant], reason=forfeit.reason)
        for forfeit in match.games[game].forfeits
    )
