"""Steps of a game as JSON documents: who did what, how likely that was, and what could be seen then."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from evaluation.captions import chances
from evaluation.exhibition import Moment, Move
from evaluation.report import Document
from league.interface import Interface
from league.spaces import Space

LARGEST = 480
"""Pixels of a picture's longer side."""
MOST_CHANCES = 32
"""Actions of one move whose probabilities are told."""

Chances = tuple[tuple[int, float], ...]
"""(action, probability), the most probable first; those that are impossible are left out."""


@dataclass(frozen=True, slots=True)
class ToldMove(Document):
    """One agent's part of a step. ref: who played it."""

    agent: str
    ref: str
    action: Any
    chances: Chances


@dataclass(frozen=True, slots=True)
class Step(Document):
    """picture: after it, as a data URI; None where there is none. opening: whether its actions were random."""

    step: int
    moves: tuple[ToldMove, ...]
    picture: str | None
    opening: bool


def step_of(
    moment: Moment, cast: Mapping[str, str], interface: Interface, picture: str | None = None, opening: int = 0
) -> Step:
    """The document of a moment. cast: agent → who plays it. opening: how many steps of the game were random."""
    moves = tuple(
        ToldMove(move.agent, cast[move.agent], move.action, likely(move, interface.agents[move.agent].action))
        for move in moment.moves
    )
    return Step(moment.step, moves, picture, 0 < moment.step <= opening)


def likely(move: Move, space: Space) -> Chances:
    """How likely the actions of a move were."""
    return tuple((action, round(chance, 6)) for action, chance in chances(move, space, MOST_CHANCES) if chance > 0)
