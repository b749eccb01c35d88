"""What a league's policies must fit: agents with their spaces, the policy of each, and the sides of a match."""

import hashlib
import json
from typing import Any

from pydantic import BaseModel, ConfigDict

from league.spaces import Space


class AgentInterface(BaseModel):
    """The spaces of one agent."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    observation: Space
    action: Space


class Interface(BaseModel):
    """All agents of an environment in the order of `possible_agents`, and how the league divides them."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    agents: dict[str, AgentInterface]
    policies: dict[str, str]
    """agent → policy id"""
    sides: dict[str, tuple[str, ...]]
    """side → its agents, in the order in which contestants rotate"""

    @property
    def policy_ids(self) -> tuple[str, ...]:
        """Each policy id once, in the order of its first agent."""
        return tuple(dict.fromkeys(self.policies[agent] for agent in self.agents))

    def apart(self) -> "Interface":
        """The same agents, each a side of its own: how a team is seated in which contestants play together."""
        return self.model_copy(update={"sides": {agent: (agent,) for agent in self.agents}})

    def of_policy(self, policy: str) -> AgentInterface:
        """The spaces that `policy` serves: those of its first agent, which equal those of its others."""
        return next(spaces for agent, spaces in self.agents.items() if self.policies[agent] == policy)

    def digest(self) -> str:
        """SHA-256 over policy ids and their spaces: what a caller of the league's policies relies on."""
        return digest({policy: self.of_policy(policy).model_dump(mode="json") for policy in self.policy_ids})


def digest(document: Any) -> str:
    """SHA-256 of a JSON document in a canonical form: sorted keys, no spaces."""
    text = json.dumps(document, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()
