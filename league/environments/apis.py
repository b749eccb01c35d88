"""The three APIs of environments: which of them an environment has, and its spaces in one form for all.

The result is an AECEnv, a ParallelEnv or an `RLlibEnv`, whose methods `observation_space` and `action_space` return the
spaces of an agent.
"""

from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import gymnasium
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils import BaseParallelWrapper

from league.errors import EnvironmentMismatch, no_exit

NAMES = {"aec": "a PettingZoo AECEnv", "parallel": "a PettingZoo ParallelEnv", "rllib": "an RLlib MultiAgentEnv"}


def api_of(env: Any, wanted: str | None) -> str | None:
    """Return the API of `env`: `wanted` if it has several, else the first of `NAMES` that it has; None without one."""
    is_pettingzoo = isinstance(env, AECEnv | ParallelEnv)
    has_rllib = (
        any(cls.__name__ == "MultiAgentEnv" for cls in type(env).__mro__)
        if is_pettingzoo
        else all(hasattr(env, name) for name in ("reset", "step", "possible_agents"))
    )
    has = {"aec": isinstance(env, AECEnv), "parallel": isinstance(env, ParallelEnv), "rllib": has_rllib}
    return next((api for api in (wanted, *NAMES) if has.get(api or "")), None)


def with_api(env: Any, api: str) -> Any:
    """Return `env` as an AECEnv, a ParallelEnv or an `RLlibEnv`. api: one that it has.

    An environment whose agents or spaces exist only after a reset is reset once.
    """
    if api == "rllib":
        env = RLlibEnv(env)
    elif api == "parallel" and isinstance(env, AECEnv):
        env = BaseParallelWrapper(env)  # hides the other API
    if not _has_spaces(env):
        with suppress(Exception):  # the next one to read the spaces reports what is missing
            env.reset(seed=0)
    return env


def _has_spaces(env: Any) -> bool:
    try:
        with no_exit:
            agents = list(env.possible_agents)
            spaces = [space(agent) for agent in agents for space in (env.observation_space, env.action_space)]
    except Exception:
        return False
    return bool(agents) and all(isinstance(space, gymnasium.Space) for space in spaces)


class RLlibEnv:
    """An RLlib MultiAgentEnv, with the spaces that RLlib would use. Other attributes are those of the environment."""

    def __init__(self, env: Any) -> None:
        self.env = env

    def __getattr__(self, name: str) -> Any:
        if name == "env":  # not yet set, while the object is copied
            raise AttributeError(name)
        return getattr(self.env, name)

    @property
    def possible_agents(self) -> list[Any]:
        """All agents. Without `possible_agents` those of `agents` or `get_agent_ids`; sets are sorted by name."""
        env = self.env
        agents = env.possible_agents or getattr(env, "agents", None) or getattr(env, "get_agent_ids", tuple)()
        ids = getattr(env, "_agent_ids", None)
        # RLlib makes the list from this set. The order of a set of strings differs between processes.
        is_unordered = isinstance(agents, set | frozenset) or (isinstance(ids, set) and list(agents) == list(ids))
        return sorted(agents, key=str) if is_unordered else list(agents)

    def observation_space(self, agent: Any) -> gymnasium.Space[Any]:
        """Return the observation space of an agent. Raises EnvironmentMismatch without one."""
        return self._space("observation_space", agent)

    def action_space(self, agent: Any) -> gymnasium.Space[Any]:
        """Return the action space of an agent. Raises EnvironmentMismatch without one."""
        return self._space("action_space", agent)

    def _space(self, name: str, agent: Any) -> gymnasium.Space[Any]:
        env = self.env
        for source in (getattr(env, f"get_{name}", None), getattr(env, f"{name}s", None), getattr(env, name, None)):
            space = _space_in(source, agent)
            if space is not None:
                return space
        common = getattr(env, name, None)
        if not getattr(env, f"{name}s", None) and isinstance(common, gymnasium.Space):
            return common
        raise EnvironmentMismatch(f"{type(env).__name__} has no {name} for agent {agent!r}: expected one in `{name}s`")


def _space_in(source: Any, agent: Any) -> gymnasium.Space[Any] | None:
    """The space of an agent in a dictionary, a Dict space or the answer of a method; None if there is none."""
    if isinstance(source, gymnasium.spaces.Dict):
        source = source.spaces
    if isinstance(source, Mapping):
        return source.get(agent)
    if isinstance(source, gymnasium.Space) or not callable(source):
        return None
    try:
        space = source(agent)
    except LookupError:
        return None
    return space if isinstance(space, gymnasium.Space) else None
