"""Interface of a league: spaces and policy of each agent, and the sides of a match."""

import hashlib
import json
from typing import Any

from league.frozen import FrozenModel
from league.spaces import Space


class AgentInterface(FrozenModel):
    """The spaces of one agent."""

    observation: Space
    action: Space


class Interface(FrozenModel):
    """Agents of an environment in the order of `possible_agents`, with their policies and sides."""

    agents: dict[str, AgentInterface]
    policies: dict[str, str]
    """Agent → policy id."""
    sides: dict[str, tuple[str, ...]]
    """Side → agents, in the order in which contestants rotate."""
    hidden_information: bool = False
    """Whether the environment hides information from opponents; see `league.conditions.hides_information`."""
    simultaneous: bool = False
    """Whether agents of several sides take discrete actions at once, without seeing those of the others."""

    @property
    def policy_ids(self) -> tuple[str, ...]:
        """Distinct policy ids, in the order of their first agents."""
        return tuple(dict.fromkeys(self.policies[agent] for agent in self.agents))

    def apart(self) -> "Interface":
        """Return the interface with one side per agent, as used for cross-play inside a team."""
        return self.model_copy(update={"sides": {agent: (agent,) for agent in self.agents}})

    def of_policy(self, policy: str) -> AgentInterface:
        """Return the spaces of a policy's agents, which are equal for all of them."""
        return next(spaces for agent, spaces in self.agents.items() if self.policies[agent] == policy)

    def digest(self) -> str:
        """Return the SHA-256 of the policy ids and their spaces, on which clients depend."""
        return digest({policy: self.of_policy(policy).model_dump(mode="json") for policy in self.policy_ids})


def digest(document: Any) -> str:
    """Return the SHA-256 of a JSON document in canonical form: sorted keys, no spaces."""
    text = json.dumps(document, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()
