"""Captions of game frames: who acted how, with which probability, and the returns so far."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from scipy.special import softmax

from evaluation.playback.single_game import GameStep, Move
from league.interface import Interface
from league.spaces import Discrete, MultiDiscrete, Space

MOST_LINES = 6
"""Agents with a line each. With more agents, those of one policy share a line."""

MOST_CHANCES = 3
MOST_NUMBERS = 4
"""Numbers of one action that are shown."""


@dataclass(frozen=True, slots=True)
class Line:
    """One agent or a group of agents.

    color: number of the contestant. chances: (action, probability), most probable first; for a group, the share of each
    action. value: return so far; for a group, the mean. shade: colour of the agents in the pictures, if the environment
    declares it.
    """

    name: str
    ref: str
    color: int
    action: str
    chances: tuple[tuple[str, float], ...]
    value: float
    acted: bool
    shade: str | None = None


@dataclass(frozen=True, slots=True)
class Caption:
    """Text of one frame."""

    title: str
    step: str
    lines: tuple[Line, ...]


class Captions:
    """Generates the captions of one game. An agent's last action stays until its next."""

    def __init__(
        self,
        title: str,
        interface: Interface,
        controllers: Mapping[str, str],
        shades: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        """controllers: agent → reference of who controls it. shades: agent → its colour in the pictures."""
        self._shades = shades
        self._title, self._interface, self._controllers = title, interface, controllers
        self._last: dict[str, Move] = {}
        self._colors = {ref: number for number, ref in enumerate(dict.fromkeys(controllers.values()))}
        self._groups = self._grouped()

    def of(self, step: GameStep) -> Caption:
        """The caption of a step. Steps must be passed in order."""
        self._last |= {move.agent: move for move in step.moves}
        acting = {move.agent for move in step.moves}
        label = f"step {step.step}" if step.step else "start"
        lines = [self._line(name, agents, step, acting) for name, agents in self._groups]
        return Caption(self._title, f"{label} · end" if step.is_over else label, tuple(lines))

    def _grouped(self) -> list[tuple[str, list[str]]]:
        agents = list(self._interface.agents)
        if len(agents) <= MOST_LINES:
            return [(agent, [agent]) for agent in agents]
        crowds: dict[tuple[str, str], list[str]] = {}
        for agent in agents:
            crowds.setdefault((self._controllers[agent], self._interface.policies[agent]), []).append(agent)
        return [
            (f"{policy} ({len(crowd)} agents)" if len(crowd) > 1 else crowd[0], crowd)
            for (_, policy), crowd in crowds.items()
        ]

    def _line(self, name: str, agents: Sequence[str], step: GameStep, acting: set[str]) -> Line:
        moves = [self._last[agent] for agent in agents if agent in self._last]
        space = self._interface.agents[agents[0]].action
        ref = self._controllers[agents[0]]
        shades = {self._shades.get(agent) for agent in agents}
        return Line(
            name=name,
            ref=ref,
            color=self._colors[ref],
            action=_action([move.action for move in moves]),
            chances=_named(chances(moves[0], space)) if len(agents) == 1 and moves else _shares(moves),
            value=sum(step.returns[agent] for agent in agents) / len(agents),
            acted=not acting.isdisjoint(agents),
            shade=shades.pop() if len(shades) == 1 else None,
        )


def _action(actions: Sequence[Any]) -> str:
    """One action as text. Several arrays give their mean; several numbers nothing, because their shares are shown."""
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
    """(action, probability) of the `most` probable actions; for MultiDiscrete, of each chosen component.

    Empty for continuous actions, scripts and remote models.
    """
    if move.dist_inputs is None:
        return ()
    inputs = move.dist_inputs.astype(np.float64)
    match space:
        case Discrete(start=start):
            likely = softmax(inputs)
            best = np.argsort(-likely, kind="stable")[:most]
            return tuple((index + start, float(likely[index])) for index in best.tolist())
        case MultiDiscrete():
            actions, raw = np.ravel(move.action), np.ravel(move.action) - np.ravel(space.start)
            parts = np.split(inputs, np.cumsum(np.ravel(space.nvec))[:-1])
            odds = [float(softmax(part)[index]) for part, index in zip(parts, raw, strict=True)]
            return tuple(zip(actions.tolist(), odds, strict=True))[:most]
    return ()


def _named(likely: Sequence[tuple[int, float]]) -> tuple[tuple[str, float], ...]:
    return tuple((str(action), chance) for action, chance in likely)


def _shares(moves: Sequence[Move]) -> tuple[tuple[str, float], ...]:
    if not moves or not isinstance(moves[0].action, int):
        return ()
    counts = Counter(move.action for move in moves)
    return tuple((str(action), n / len(moves)) for action, n in counts.most_common(MOST_CHANCES))
