"""What is written below a picture of a game: who did what, how likely that was, and what it has brought."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import softmax

from evaluation.exhibition import Moment, Move
from league.interface import Interface
from league.spaces import Discrete, MultiDiscrete, Space

MOST_LINES = 6
"""Agents that have a line each; more than these share one with all that the same policy plays."""

MOST_CHANCES = 3
MOST_NUMBERS = 4
"""Numbers of one action that are written out."""


@dataclass(frozen=True, slots=True)
class Line:
    """One agent, or a crowd of them.

    color: a number for each contestant. chances: (action, probability), the most probable ones, or of a crowd the share
    that took each action. value: the return so far, a crowd's mean.
    """

    name: str
    ref: str
    color: int
    action: str
    chances: tuple[tuple[str, float], ...]
    value: float
    acted: bool


@dataclass(frozen=True, slots=True)
class Caption:
    """Words of one frame."""

    title: str
    step: str
    lines: tuple[Line, ...]


class Captions:
    """Follows one game. An agent's last action stays until its next."""

    def __init__(self, title: str, interface: Interface, cast: Mapping[str, str]) -> None:
        """cast: agent → who plays it."""
        self._title, self._interface, self._cast = title, interface, cast
        self._last: dict[str, Move] = {}
        self._colors = {ref: number for number, ref in enumerate(dict.fromkeys(cast.values()))}
        self._groups = self._grouped()

    def of(self, moment: Moment) -> Caption:
        """The caption of a moment; moments are given in their order."""
        self._last |= {move.agent: move for move in moment.moves}
        acting = {move.agent for move in moment.moves}
        step = f"step {moment.step}" if moment.step else "start"
        lines = [self._line(name, agents, moment, acting) for name, agents in self._groups]
        return Caption(self._title, f"{step} · end" if moment.is_over else step, tuple(lines))

    def _grouped(self) -> list[tuple[str, list[str]]]:
        agents = list(self._interface.agents)
        if len(agents) <= MOST_LINES:
            return [(agent, [agent]) for agent in agents]
        crowds: dict[tuple[str, str], list[str]] = {}
        for agent in agents:
            crowds.setdefault((self._cast[agent], self._interface.policies[agent]), []).append(agent)
        return [
            (f"{policy} ({len(own)} agents)" if len(own) > 1 else own[0], own) for (_, policy), own in crowds.items()
        ]

    def _line(self, name: str, agents: Sequence[str], moment: Moment, acting: set[str]) -> Line:
        moves = [self._last[agent] for agent in agents if agent in self._last]
        space = self._interface.agents[agents[0]].action
        ref = self._cast[agents[0]]
        return Line(
            name=name,
            ref=ref,
            color=self._colors[ref],
            action=_action([move.action for move in moves]),
            chances=_named(chances(moves[0], space)) if len(agents) == 1 and moves else _shares(moves),
            value=sum(moment.returns[agent] for agent in agents) / len(agents),
            acted=not acting.isdisjoint(agents),
        )


def _action(actions: Sequence[Any]) -> str:
    """One action; of several that are numbers, nothing, since their shares say it; of several arrays their mean."""
    if not actions or (len(actions) > 1 and isinstance(actions[0], int)):
        return ""
    mean = np.mean(np.array(actions, dtype=np.float64), axis=0).reshape(-1)
    is_whole = len(actions) == 1 and not any(
        isinstance(number, float) for number in np.array(actions[0]).reshape(-1).tolist()
    )
    numbers = [f"{number:.0f}" if is_whole else f"{number:+.2f}" for number in mean[:MOST_NUMBERS]]
    words = ["mean"] * (len(actions) > 1) + numbers + ["…"] * (mean.size > MOST_NUMBERS)
    return " ".join(words)


def chances(move: Move, space: Space, most: int = MOST_CHANCES) -> tuple[tuple[int, float], ...]:
    """(action, probability) of the `most` probable actions; of several choices at once that of each that was made;
    nothing for continuous actions, and where nobody was asked how likely they were."""
    if move.dist_inputs is None:
        return ()
    inputs = move.dist_inputs.astype(np.float64)
    match space:
        case Discrete(start=start):
            likely = softmax(inputs)
            best = np.argsort(-likely, kind="stable")[:most]
            return tuple((index + start, float(likely[index])) for index in best.tolist())
        case MultiDiscrete():
            chosen, raw = np.ravel(move.action), np.ravel(move.action) - np.ravel(space.start)
            parts = np.split(inputs, np.cumsum(np.ravel(space.nvec))[:-1])
            odds = [float(softmax(part)[index]) for part, index in zip(parts, raw, strict=True)]
            return tuple(zip(chosen.tolist(), odds, strict=True))[:most]
    return ()


def _named(likely: Sequence[tuple[int, float]]) -> tuple[tuple[str, float], ...]:
    return tuple((str(action), chance) for action, chance in likely)


def _shares(moves: Sequence[Move]) -> tuple[tuple[str, float], ...]:
    if not moves or not isinstance(moves[0].action, int):
        return ()
    counts = Counter(move.action for move in moves)
    return tuple((str(action), n / len(moves)) for action, n in counts.most_common(MOST_CHANCES))
