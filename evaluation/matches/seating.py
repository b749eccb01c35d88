"""Which policy acts for each agent, in the openings of games and after them, and what the sides of agents return.

The member of a mixture that plays a game is drawn from the seed of the game.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import mean

import numpy as np
from numpy.typing import NDArray

from evaluation.schedules.builders import GamePlans
from league.environments.stepping import Indices
from league.interface import Interface
from league.policies.onnx import OnnxPolicy
from league.policies.policy import Policy
from league.registry.storage.manifest import Mixture
from league.results.records import Members, Schedule
from league.search.policies import SearchPolicy

Returns = tuple[float | None, ...]
"""The return of each contestant; None for one that did not take part."""


def agent_sides(agents: Sequence[str], interface: Interface) -> list[int]:
    """The number of each agent's side."""
    side = {agent: i for i, members in enumerate(interface.sides.values()) for agent in members}
    return [side[agent] for agent in agents]


def contestant_returns(
    returns: Sequence[float], side_of: Sequence[int], sides: Sequence[int], contestants: int = 2
) -> Returns:
    """Return of each contestant: the mean over the agents of a side, then over its sides; None without sides.

    returns, side_of: of each agent. sides: the contestant of each side.
    Means are rounded once (`statistics.mean` adds fractions), so that sides with equal returns tie exactly.
    """
    of_side: list[list[float]] = [[] for _ in sides]
    for value, side in zip(returns, side_of, strict=True):
        of_side[side].append(value)
    of_contestant: list[list[float]] = [[] for _ in range(contestants)]
    for values, contestant in zip(of_side, sides, strict=True):
        of_contestant[contestant].append(_mean(values))
    return tuple(_mean(values) if values else None for values in of_contestant)


def returns_of_games(returns: NDArray[np.float64], side_of: Sequence[int], sides: NDArray[np.int64]) -> list[Returns]:
    """Return `contestant_returns` of each game. returns: (games, agents). sides: (games, sides)."""
    if sorted(side_of) == [0, 1]:
        # Two agents on two sides: no means.
        of_contestant = np.argsort(np.asarray(sides)[:, side_of], axis=1)
        return list(map(tuple, np.take_along_axis(returns, of_contestant, axis=1).tolist()))
    return [
        contestant_returns(agent_returns, side_of, seating)
        for agent_returns, seating in zip(returns.tolist(), sides.tolist(), strict=True)
    ]


def _mean(values: Sequence[float]) -> float:
    return values[0] if len(values) == 1 else float(mean(values))


NO_MIXTURES: Mapping[str, Mixture] = {}


@dataclass(frozen=True, slots=True)
class ActingVersions:
    """Who plays the games of some plans in place of mixtures.

    Attributes:
        refs: The contestants of the schedule, followed by the members of mixtures that were drawn.
        indices: Who acts for each contestant of the match, as an index into `refs`, (g, 2).
        members: Of each game, see `Game.members`, (g,).
    """

    refs: tuple[str, ...]
    indices: NDArray[np.int64]
    members: tuple[Members, ...]


def acting_versions(schedule: Schedule, plans: GamePlans, mixtures: Mapping[str, Mixture]) -> ActingVersions:
    """Draw who plays the games of `plans`.

    mixtures: contestant → its members. A draw depends on the seed of the game, its number in the block and the mixture
    only: two contestants that play against one mixture from common seeds meet the same members.
    """
    refs, games = schedule.contestants, range(len(plans))
    if not mixtures.keys() & set(refs):
        return ActingVersions(refs, plans.contestants, ((),) * len(games))
    number = {ref: index for index, ref in enumerate(refs)}
    indices, members = plans.contestants.copy(), list[Members]()
    for game in games:
        drawn: list[int | None] = []
        for place, contestant in enumerate(plans.contestants[game].tolist()):
            ref = refs[contestant]
            version = None
            if ref in mixtures:
                episode = f"{plans.seeds[game]}/{plans.indices[game]}/{ref}"
                version = mixtures[ref].version_of(schedule.league, episode.encode())
                acting = f"{schedule.league}@{version}"
                indices[game, place] = number.setdefault(acting, len(number))
            drawn.append(version)
        members.append(() if drawn == [None] * len(drawn) else tuple(drawn))
    return ActingVersions(tuple(number), indices, tuple(members))


Roster = Mapping[str, Mapping[str, tuple[str, Policy]]]
"""reference → agent → (policy id, policy)"""

NO_GROUP = -1


@dataclass(frozen=True, slots=True)
class SeatedPolicy:
    """The policy that acts for the rows of one group.

    ref, policy: of a contestant; None for random opening moves. samples: whether it samples its actions from the
    distribution of its graph.
    """

    policy_id: str
    ref: str | None = None
    policy: Policy | None = None
    samples: bool = False

    @property
    def is_script(self) -> bool:
        return self.ref is not None and self.ref.startswith("script:")


class Seating:
    """The groups of agents in some games.

    Attributes:
        policies: The policy of each group, which is its index.
        in_opening: Group of each agent during openings, (agents,).
        after_opening: Group of each agent in each game after its opening, (g, agents).
    """

    def __init__(
        self,
        schedule: Schedule,
        plans: GamePlans,
        interface: Interface,
        roster: Roster,
        agents: Sequence[str],
        side_of: Sequence[int],
        acting: ActingVersions,
    ) -> None:
        seated: dict[tuple[str | None, str], SeatedPolicy] = {
            (None, policy_id): SeatedPolicy(policy_id) for policy_id in interface.policy_ids
        }
        sampling = (OnnxPolicy, SearchPolicy) if schedule.actions == "sampled" else ()
        seated |= {
            (ref, policy_id): SeatedPolicy(policy_id, ref, policy, isinstance(policy, sampling))
            for ref, policies in roster.items()
            for policy_id, policy in policies.values()
        }
        self.policies = list(seated.values())
        number = {key: i for i, key in enumerate(seated)}
        self.in_opening = np.array([number[None, interface.policies[agent]] for agent in agents])
        of_ref = np.full((len(acting.refs), len(agents)), NO_GROUP)
        for index, ref in enumerate(acting.refs):
            if ref in roster:
                of_ref[index] = [number[ref, roster[ref][agent][0]] for agent in agents]
        refs = np.take_along_axis(acting.indices, plans.sides[:, side_of], axis=1)
        self.after_opening: Indices = of_ref[refs, np.arange(len(agents))]
