"""Action masks that environments report in `infos`: they become part of the observations."""

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, MultiDiscrete
from numpy.typing import NDArray
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils import BaseParallelWrapper, BaseWrapper

from league.environments.apis import RLlibEnv
from league.errors import InvalidReturn, no_exit
from league.spaces import ACTION_MASK, OBSERVATION
from league.spaces.arrays import mask_size
from league.spaces.conversion import from_gymnasium

_reports_masks: dict[str, bool] = {}
"""Configuration of an environment → whether its infos contain masks. Finding out takes a reset."""


def with_info_masks(env: Any, configuration: str) -> Any:
    """Move masks from `info["action_mask"]` into the observations, if the environment reports them there.

    Agents with discrete actions then observe `{"observation": …, "action_mask": …}`. An agent whose info has no mask
    may take all actions. An `action_mask` in the observation itself takes precedence.

    Args:
        env: An environment of any API.
        configuration: A text that is equal for environments that are built alike. The first of them is reset once.
    """
    if configuration not in _reports_masks:
        _reports_masks[configuration] = _finds_masks(env)
    if not _reports_masks[configuration]:
        return env
    if isinstance(env, AECEnv):
        return _AECInfoMasks(env)
    return _ParallelInfoMasks(env) if isinstance(env, ParallelEnv) else _RLlibInfoMasks(env)


def _finds_masks(env: Any) -> bool:
    try:
        with no_exit:
            if all(_missing_mask(env, agent) is None for agent in env.possible_agents):
                return False
            returned = env.reset(seed=0)
            infos = env.infos if isinstance(env, AECEnv) else returned[1]
            return any(isinstance(info, Mapping) and ACTION_MASK in info for info in infos.values())
    except Exception:
        # The same call fails again where its error is reported with the seed.
        return False


def _missing_mask(env: Any, agent: str) -> int | None:
    """Return the size of the mask that an agent could observe and does not."""
    observation, action = env.observation_space(agent), env.action_space(agent)
    has_mask = isinstance(observation, Dict) and ACTION_MASK in observation.spaces
    return None if has_mask or not isinstance(action, Discrete | MultiDiscrete) else mask_size(from_gymnasium(action))


class _InfoMasks:
    """The spaces of the agents, and the mask of an info."""

    env: Any

    def __init__(self, env: Any) -> None:
        super().__init__(env)  # type: ignore[call-arg]
        self._widths = {agent: size for agent in env.possible_agents if (size := _missing_mask(env, agent)) is not None}
        self._observation_spaces: dict[str, gymnasium.Space[Any]] = {
            agent: Dict({OBSERVATION: env.observation_space(agent), ACTION_MASK: Box(0, 1, (width,), np.int8)})
            for agent, width in self._widths.items()
        }

    def observation_space(self, agent: str) -> gymnasium.Space[Any]:
        """Return the space of the observation with the mask. The same object for each call, as PettingZoo requires."""
        space = self._observation_spaces.get(agent)
        return self.env.observation_space(agent) if space is None else space

    def action_space(self, agent: str) -> gymnasium.Space[Any]:
        """Return the action space."""
        return self.env.action_space(agent)

    def _with_mask(self, agent: str, observation: Any, info: Any) -> Any:
        if agent not in self._widths:
            return observation
        return {OBSERVATION: observation, ACTION_MASK: self._mask(agent, info)}

    def _mask(self, agent: str, info: Any) -> NDArray[np.int8]:
        width = self._widths[agent]
        info_mask = info.get(ACTION_MASK) if isinstance(info, Mapping) else None
        if info_mask is None:
            return np.ones(width, np.int8)
        mask = np.asarray(info_mask)
        if mask.shape != (width,):
            raise InvalidReturn(
                f"the info of agent {agent!r} has an action_mask of shape {list(mask.shape)}, expected [{width}]"
            )
        return mask.astype(np.int8)


class _AECInfoMasks(_InfoMasks, BaseWrapper):
    """An AEC environment whose observations contain the masks."""

    def observe(self, agent: str) -> Any:
        """Return the agent's observation with its mask."""
        return self._with_mask(agent, self.env.observe(agent), self.env.infos.get(agent))


class _SimultaneousInfoMasks(_InfoMasks):
    """Observations with masks for APIs with simultaneous actions."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        """Reset the environment; the observations contain the masks."""
        observations, infos = self.env.reset(seed=seed, options=options)
        return self._all_with_masks(observations, infos), infos

    def step(self, actions: dict[str, Any]) -> Any:
        """Step the environment; the observations contain the masks."""
        observations, *outcomes, infos = self.env.step(actions)
        return self._all_with_masks(observations, infos), *outcomes, infos

    def _all_with_masks(self, observations: Mapping[str, Any], infos: Mapping[str, Any]) -> dict[str, Any]:
        return {agent: self._with_mask(agent, value, infos.get(agent)) for agent, value in observations.items()}


class _ParallelInfoMasks(_SimultaneousInfoMasks, BaseParallelWrapper): ...


class _RLlibInfoMasks(_SimultaneousInfoMasks, RLlibEnv): ...
