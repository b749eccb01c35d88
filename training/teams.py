"""Teams: agents whose values are mixed to one."""

from collections.abc import Mapping

from league.environments.building import divide
from league.errors import ConfigError
from league.interface import Interface
from league.spaces import Discrete

Teams = dict[str, tuple[str, ...]]
"""group → its agents, in the order of `possible_agents`."""


def teams(groups: Mapping[str, tuple[str, ...]] | None, interface: Interface) -> Teams:
    """The agents of each group; of each side where no groups are named.

    Raises ConfigError where a pattern fits no agent, an agent fits no group, acts otherwise than by Discrete actions,
    or has other spaces than the rest of its group.
    """
    if groups is None:
        found = {
            group: tuple(agent for agent in interface.agents if agent in own) for group, own in interface.sides.items()
        }
        key = "sides"
    else:
        group_of = divide("training.groups", dict(groups), list(interface.agents))
        found = {group: tuple(agent for agent in interface.agents if group_of[agent] == group) for group in groups}
        key = "training.groups"
    for group, members in found.items():
        for agent in members:
            _check(f"{key}.{group}", members[0], agent, interface)
    return found


def _check(where: str, first: str, agent: str, interface: Interface) -> None:
    own, others = interface.agents[agent], interface.agents[first]
    if not isinstance(own.action, Discrete):
        raise ConfigError(
            f"{where}: qmix needs Discrete actions, and {agent} has {own.action!r}: train it with algorithm: ppo, or"
            " with maddpg if it is continuous"
        )
    if own.action != others.action:
        raise ConfigError(
            f"{where}: {first} and {agent} have different action spaces: pad them with SuperSuit's pad_action_space_v0"
        )
    if own.observation != others.observation:
        raise ConfigError(
            f"{where}: {first} and {agent} have different observation spaces: pad them with SuperSuit's"
            " pad_observations_v0"
        )
