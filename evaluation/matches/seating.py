"""Which policy acts for each agent, in the openings of games and after them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from evaluation.matches.acting_versions import ActingVersions
from evaluation.schedules.builders import GamePlans
from league.environments.stepping import Indices
from league.interface import Interface
from league.policies.onnx import OnnxPolicy
from league.policies.policy import Policy
from league.results.records import Schedule

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
        is_sampled = schedule.actions == "sampled"
        seated |= {
            (ref, policy_id): SeatedPolicy(policy_id, ref, policy, is_sampled and isinstance(policy, OnnxPolicy))
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
