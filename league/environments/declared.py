"""The environment of a game that runs in simulators: the declared spaces, and nothing to step."""

from typing import Any, NoReturn

import gymnasium
from pettingzoo import AECEnv, ParallelEnv

from league.config.external import ExternalConfig
from league.errors import ConfigError, EnvironmentMismatch, one_line
from league.spaces import Space
from league.spaces.conversion import to_gymnasium


def declared(config: ExternalConfig) -> Any:
    """Return an environment of PettingZoo with the declared spaces, which cannot be reset.

    Raises ConfigError for a space that does not exist, such as one with an unknown dtype.
    """
    return (_ParallelGame if config.simultaneous else _TurnBasedGame)(config)


def _space(agent: str, kind: str, space: Space) -> gymnasium.Space[Any]:
    try:
        return to_gymnasium(space)
    except Exception as error:
        raise ConfigError(
            f"environment.external.agents.{agent}.{kind}: no such space: {one_line(error, with_type=True)}"
        ) from error


class _Declared:
    def __init__(self, config: ExternalConfig) -> None:
        self._simulator = config.simulator
        self._spaces = {
            agent: (_space(agent, "observation", spaces.observation), _space(agent, "action", spaces.action))
            for agent, spaces in config.agents.items()
        }
        self.possible_agents, self.agents = list(config.agents), list[str]()
        # Whoever acts at once hides his action: `simultaneous` says so for the others.
        is_declared = config.hidden_information or not config.simultaneous
        self.metadata = {"hidden_information": config.hidden_information} if is_declared else {}

    def observation_space(self, agent: str) -> gymnasium.Space[Any]:
        """Return the declared space."""
        return self._spaces[agent][0]

    def action_space(self, agent: str) -> gymnasium.Space[Any]:
        """Return the declared space."""
        return self._spaces[agent][1]

    def reset(self, *_: Any, **__: Any) -> NoReturn:
        """Raise EnvironmentMismatch."""
        raise EnvironmentMismatch(
            f"this game runs in the simulator {self._simulator}, outside of Python: it can be trained and evaluated,"
            " but not shown or examined here"
        )

    step = render = observe = reset

    def close(self) -> None:
        """Do nothing."""


class _TurnBasedGame(_Declared, AECEnv):
    """Agents act one after the other."""


class _ParallelGame(_Declared, ParallelEnv):
    """Agents act at once."""
