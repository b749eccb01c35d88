"""Names of agents that are no strings, and action masks that environments report in `infos`.

Agents such as the integers of RLlib's examples get their texts as names; the environment receives its own ids. Masks
become part of the observations.
"""

from collections.abc import Hashable, Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, MultiDiscrete
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils import BaseParallelWrapper, BaseWrapper

from league.environments.apis import RLlibEnv
from league.errors import EnvironmentMismatch, InvalidReturn, no_exit
from league.spaces import ACTION_MASK, OBSERVATION
from league.spaces.arrays import mask_size
from league.spaces.conversion import from_gymnasium

_sizes_of_masks: dict[str, dict[str, int]] = {}
"""Configuration of an environment → agent → size of the mask in its info. Finding out takes a reset."""


def with_names(env: Any) -> Any:
    """Return `env`, whose agents are strings. Raises EnvironmentMismatch if two agents have the same name."""
    ids: dict[str, Any] = {}
    for agent in getattr(env, "possible_agents", ()) or ():
        if (name := _name(agent)) in ids:
            raise EnvironmentMismatch(f"agents {ids[name]!r} and {agent!r} have the same name, expected different ones")
        ids[name] = agent
    return env if _are_names(ids) else _wrapped(env, ids, {})


def with_info_masks(env: Any, configuration: str) -> Any:
    """Move masks from `info["action_mask"]` into the observations, if the environment reports them there.

    Agents with discrete actions then observe `{"observation": …, "action_mask": …}`. An agent whose info has no mask
    may take all actions. An `action_mask` in the observation itself takes precedence.

    Args:
        env: An environment of any API, whose agents are strings.
        configuration: A text that is equal for environments that are built alike. The first of them is reset once.
    """
    if configuration not in _sizes_of_masks:
        _sizes_of_masks[configuration] = _mask_sizes(env)
    sizes = _sizes_of_masks[configuration]
    return _wrapped(env, {agent: agent for agent in env.possible_agents}, sizes) if sizes else env


def _name(agent: Hashable) -> str:
    return agent if isinstance(agent, str) else str(agent)


def _are_names(ids: Mapping[str, Any]) -> bool:
    return all(name is agent for name, agent in ids.items())


def _mask_sizes(env: Any) -> dict[str, int]:
    """Return the sizes of the masks that agents could observe and do not; none if no info has a mask after a reset."""
    try:
        with no_exit:
            sizes = {agent: size for agent in env.possible_agents if (size := _missing_mask(env, agent)) is not None}
            if not sizes:
                return {}
            returned = env.reset(seed=0)
            infos = env.infos if isinstance(env, AECEnv) else returned[1]
            has_masks = any(isinstance(info, Mapping) and ACTION_MASK in info for info in infos.values())
            return sizes if has_masks else {}
    except Exception:
        # The same call fails again where its error is reported with the seed.
        return {}


def _missing_mask(env: Any, agent: str) -> int | None:
    observation, action = env.observation_space(agent), env.action_space(agent)
    has_mask = isinstance(observation, Dict) and ACTION_MASK in observation.spaces
    return None if has_mask or not isinstance(action, Discrete | MultiDiscrete) else mask_size(from_gymnasium(action))


def _wrapped(env: Any, ids: Mapping[str, Any], sizes: Mapping[str, int]) -> Any:
    if isinstance(env, AECEnv):
        return _AEC(env, ids, sizes)
    return (_Parallel if isinstance(env, ParallelEnv) else _RLlib)(env, ids, sizes)


class _NamesAndMasks:
    """An environment whose agents have names, or whose observations contain masks.

    agent_ids: name → agent of the environment. sizes: name → size of the mask, of agents that observe that of their
    info.
    """

    def __init__(self, env: Any, agent_ids: Mapping[str, Any], sizes: Mapping[str, int]) -> None:
        super().__init__(env)  # type: ignore[call-arg]
        self.env: Any = env
        self._ids, self._sizes, self._keeps_names = agent_ids, sizes, _are_names(agent_ids)
        if not self._keeps_names:
            self.agent_ids = agent_ids  # otherwise those of a wrapper below are found, which `render_for` needs
        self._with_masks = {
            agent: Dict({OBSERVATION: env.observation_space(agent), ACTION_MASK: Box(0, 1, (size,), np.int8)})
            for agent, size in sizes.items()
        }

    @property
    def possible_agents(self) -> list[str]:
        return list(self._ids)

    @property
    def agents(self) -> list[str]:
        return [_name(agent) for agent in self.env.agents]

    def observation_space(self, agent: str) -> gymnasium.Space[Any]:
        """Return the space of the observation. With a mask, the same object for each call, as PettingZoo requires."""
        space = self._with_masks.get(agent)
        return self.env.observation_space(self._ids[agent]) if space is None else space

    def action_space(self, agent: str) -> gymnasium.Space[Any]:
        return self.env.action_space(self._ids[agent])

    def _named(self, values: Any) -> Any:
        """Return a dictionary by name for one by agent of the environment. A wrong return stays as it is."""
        if self._keeps_names or not isinstance(values, Mapping):
            return values
        return {_name(agent): value for agent, value in values.items()}

    def _observed(self, agent: str, observation: Any, infos: Mapping[str, Any]) -> Any:
        if agent not in self._sizes:
            return observation
        size, info = self._sizes[agent], infos.get(agent)
        info_mask = info.get(ACTION_MASK) if isinstance(info, Mapping) else None
        mask = np.ones(size) if info_mask is None else np.asarray(info_mask)
        if mask.shape != (size,):
            raise InvalidReturn(
                f"the info of agent {agent!r} has an action_mask of shape {list(mask.shape)}, expected [{size}]"
            )
        return {OBSERVATION: observation, ACTION_MASK: mask.astype(np.int8)}


class _Simultaneous(_NamesAndMasks):
    """PettingZoo's Parallel API and RLlib's."""

    def reset(self, **arguments: Any) -> Any:
        return self._returned(self.env.reset(**arguments))

    def step(self, actions: Mapping[str, Any]) -> Any:
        return self._returned(self.env.step({self._ids[name]: action for name, action in actions.items()}))

    def _returned(self, returned: Any) -> Any:
        if not isinstance(returned, tuple):
            return returned
        named = [*map(self._named, returned)]
        if self._sizes:
            named[0] = {agent: self._observed(agent, value, named[-1]) for agent, value in named[0].items()}
        return tuple(named)


class _Parallel(_Simultaneous, BaseParallelWrapper): ...


class _RLlib(_Simultaneous, RLlibEnv): ...


class _AEC(_NamesAndMasks, BaseWrapper):
    agent_selection = property(lambda self: _name(self.env.agent_selection))
    rewards = property(lambda self: self._named(self.env.rewards))
    terminations = property(lambda self: self._named(self.env.terminations))
    truncations = property(lambda self: self._named(self.env.truncations))
    infos = property(lambda self: self._named(self.env.infos))
    _cumulative_rewards = property(lambda self: self._named(self.env._cumulative_rewards))

    def reset(self, **arguments: Any) -> None:
        self.env.reset(**arguments)

    def observe(self, agent: str) -> Any:
        return self._observed(agent, self.env.observe(self._ids[agent]), self.infos)
