"""Who plays whom in an episode: the league's own policies, and in some episodes an opponent that does not learn."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from league.errors import ConfigError
from league.interface import Interface
from league.training_config import OpponentConfig


@dataclass(frozen=True, slots=True)
class Opposing:
    """The group of agents that an opponent plays: a reference, and which of its policies."""

    ref: str
    policy: str


Seat = str | Opposing
"""Who plays an agent: a policy of the league's own, by its id, or an opponent."""


class Seats:
    """Draws, for each episode, an opponent or none by their shares, and the side that learns against it."""

    def __init__(self, interface: Interface, opponents: Sequence[OpponentConfig], agents: Sequence[str]) -> None:
        """Raises ConfigError where opponents are asked for and there is no other side for them."""
        if opponents and len(interface.sides) < 2:
            raise ConfigError(
                "training.opponents: the league has one side only, so that nobody can be played against: divide the"
                " agents into sides"
            )
        self._refs = [opponent.ref for opponent in opponents]
        self._shares = np.cumsum([opponent.share for opponent in opponents])
        self._agents = tuple(agents)
        self._own: tuple[Seat, ...] = tuple(interface.policies[agent] for agent in agents)
        self._sides = [frozenset(members) for members in interface.sides.values()]

    def draw(self, rng: np.random.Generator) -> tuple[Seat, ...]:
        """Who plays each agent of the next episode."""
        if not self._refs:
            return self._own
        index = int(np.searchsorted(self._shares, rng.random(), side="right"))
        if index == len(self._refs):
            return self._own
        learning = self._sides[int(rng.integers(len(self._sides)))]
        return tuple(
            policy if agent in learning else Opposing(self._refs[index], str(policy))
            for agent, policy in zip(self._agents, self._own, strict=True)
        )
