"""Who may sit down to play in a league: as which agents, against whom, and whether there is something to see."""

from __future__ import annotations

from dataclasses import dataclass

from evaluation.contestants import baselines
from evaluation.report import Document
from league.interface import Interface
from league.policies.pinning import eligible
from league.registry.registry import Registry
from league.spaces import Discrete

MOST_OPPONENTS = 50


@dataclass(frozen=True, slots=True)
class Seat(Document):
    """An agent that a person can play: its actions are the `actions` integers from `start` on."""

    agent: str
    side: str
    actions: int
    start: int


@dataclass(frozen=True, slots=True)
class Table(Document):
    """why: why nobody can play here, None if somebody can. draws: whether games can be seen.

    opponents: versions that can play, newest first and the newest only, then scripts.
    """

    league: str
    playable: bool
    why: str | None
    agents: tuple[Seat, ...]
    opponents: tuple[str, ...]
    draws: bool


def table(league: str, registry: Registry, interface: Interface, draws: bool) -> Table:
    """What there is to choose from. draws: whether the environment gives pictures. Raises UnknownLeague."""
    side_of = {agent: side for side, agents in interface.sides.items() for agent in agents}
    seats = tuple(
        Seat(agent, side_of[agent], spaces.action.n, spaces.action.start)
        for agent, spaces in interface.agents.items()
        if isinstance(spaces.action, Discrete)
    )
    kinds = sorted({type(spaces.action).__name__ for spaces in interface.agents.values()})
    why = None if seats else f"its agents act by {' and '.join(kinds)}: a person chooses one of several actions"
    versions = [version.ref for version in reversed(eligible(registry, league))]
    return Table(
        league=league,
        playable=bool(seats),
        why=why,
        agents=seats,
        opponents=(*versions[:MOST_OPPONENTS], *baselines(interface)),
        draws=draws,
    )
