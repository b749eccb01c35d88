"""Applies the vectorised versions of SuperSuit's wrappers to vectorised environments."""

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from league.config.environment import EnvironmentConfig, WrapperConfig
from league.environments.building import build
from league.environments.vector.vector_env import AgentRows, VectorEnv
from league.environments.wrappers.transforms import Transform, UnsupportedWrapper, transform
from league.environments.wrappers.wrapping import AgentSpaces, agent_spaces, with_arguments
from league.spaces import OBSERVATION

MakeVectorEnv = Callable[..., VectorEnv]
"""Number of copies and the arguments of the stock environment → vectorised environment."""
Change = Callable[[NDArray[Any]], NDArray[Any]]
OF_ACTIONS = ("pad_action_space_v0", "clip_actions_v0", "scale_actions_v0")
OF_REWARDS = ("clip_reward_v0",)
"""Wrappers of actions and of rewards. All others are wrappers of observations."""


class WrapperStack:
    """The wrappers of an environment, the first one innermost, and the agents' spaces before each and after the last.

    Attributes:
        stages: The spaces.
        actions: What the wrappers do to actions (k, …), the outermost first.
        rewards: What the wrappers do to rewards, (k,) float64, the innermost first.
    """

    def __init__(self, config: EnvironmentConfig) -> None:
        """Raises ConfigError for wrappers that SuperSuit does not accept, and UnsupportedWrapper."""
        self._wrappers = [with_arguments(wrapper_config) for wrapper_config in config.wrappers]
        with closing(build(config.model_copy(update={"wrappers": ()}))) as env:
            self.stages = agent_spaces(env, config.wrappers)
            is_turn_based = not isinstance(env, ParallelEnv)
        for wrapper in config.wrappers:
            # In turn-based environments, some wrappers of observations also count the turns of other agents, and a
            # reward is the sum of several rewards, each of which is clipped. In the verified ones all but the last are
            # 0.
            if is_turn_based and (wrapper.name not in OF_REWARDS or config.vector is not None):
                raise UnsupportedWrapper(f"wrapper {wrapper.name} is vectorised for simultaneous actions only")
        before = list(zip(self._wrappers, self.stages, strict=False))
        actions = [_action_change(wrapper, stage) for wrapper, stage in before if wrapper.name in OF_ACTIONS]
        self.actions: list[Change] = [change for change in reversed(actions) if change is not None]
        self.rewards = [_reward_change(wrapper) for wrapper in self._wrappers if wrapper.name in OF_REWARDS]

    def transforms(self, agent: int, agents: Sequence[str], num_envs: int) -> list[Transform]:
        """Return what the wrappers do to the observations of an agent, and of others with the same space.

        Raises UnsupportedWrapper.
        """
        return [
            transform(wrapper, before.observations[agent], after.observations[agent], agents, num_envs)
            for wrapper, before, after in zip(self._wrappers, self.stages, self.stages[1:], strict=False)
            if wrapper.name not in (*OF_ACTIONS, *OF_REWARDS)
        ]


class WrappedVectorEnv(VectorEnv):
    """A vectorised environment with wrappers. Its reports equal those of the stock environment with SuperSuit's."""

    def __init__(self, env: VectorEnv, stack: WrapperStack) -> None:
        """Raises UnsupportedWrapper."""
        self.num_envs, self.possible_agents = env.num_envs, env.possible_agents
        self._env = env
        self._stack = stack
        before, after = stack.stages[0].observations, stack.stages[-1].observations
        self._first_before = [before.index(space) for space in before]
        self._first_after = [after.index(space) for space in after]
        self._transforms = {
            first: stack.transforms(first, self.possible_agents, self.num_envs) for first in set(self._first_before)
        }
        self._dtypes = [space.dtype for space in after]

    def reset(self, env_ids: NDArray[np.int64], seeds: NDArray[np.int64]) -> Sequence[AgentRows]:
        """See VectorEnv."""
        slots = self._slots(env_ids)
        for transforms in self._transforms.values():
            for observation_transform in transforms:
                observation_transform.reset(slots)
        return self._wrapped(self._env.reset(env_ids, seeds))

    def step(self, env_ids: NDArray[np.int64], actions: NDArray[Any]) -> Sequence[AgentRows]:
        """See VectorEnv."""
        for change in self._stack.actions:
            actions = change(actions)
        return self._wrapped(self._env.step(env_ids, actions))

    def copy(self, source: NDArray[np.int64], target: NDArray[np.int64]) -> None:
        """See VectorEnv."""
        self._env.copy(source, target)
        for transforms in self._transforms.values():
            for observation_transform in transforms:
                observation_transform.copy(self._slots(source), self._slots(target))

    def use_fast_seeds(self) -> None:
        """See VectorEnv."""
        self._env.use_fast_seeds()

    def state(self, env_ids: NDArray[np.int64]) -> NDArray[np.float32] | None:
        """See VectorEnv. Wrappers do not change the state."""
        return self._env.state(env_ids)

    def _slots(self, env_ids: NDArray[np.int64]) -> NDArray[np.int64]:
        agents = len(self.possible_agents)
        return (env_ids[:, np.newaxis] * agents + np.arange(agents)).ravel()

    def _wrapped(self, blocks: Sequence[AgentRows]) -> Sequence[AgentRows]:
        """Change the rows, and join those of agents whose spaces have become equal."""
        changed_blocks = []
        for rows in blocks:
            if not len(rows.envs):
                continue
            agent, rewards, observations = rows.agents[0], rows.rewards, rows.observations
            for change in self._stack.rewards:
                rewards = change(rewards)
            if transforms := self._transforms[self._first_before[agent]]:
                slots = rows.envs * len(self.possible_agents) + rows.agents
                changed = observations[OBSERVATION]
                for observation_transform in transforms:
                    changed = observation_transform(changed, slots)
                observations = {OBSERVATION: changed.astype(self._dtypes[agent], copy=False)}
            changed_blocks.append(replace(rows, rewards=rewards, observations=observations))
        return AgentRows.of_spaces(changed_blocks, self._first_after)


def wrapped_vector(make: MakeVectorEnv, config: EnvironmentConfig) -> MakeVectorEnv:
    """Return a vectorised environment with the wrappers of its configuration.

    Raises ConfigError for wrappers that SuperSuit does not support, and UnsupportedWrapper.
    """
    stack = WrapperStack(config)

    def make_wrapped(num_envs: int, **kwargs: Any) -> VectorEnv:
        return WrappedVectorEnv(make(num_envs, **kwargs), stack)

    make_wrapped(1, **config.kwargs)
    return make_wrapped


def _action_change(wrapper: WrapperConfig, before: AgentSpaces) -> Change | None:
    """Return what a wrapper does to actions; None if nothing."""
    space = before.actions[0]
    if any(other != space for other in before.actions):
        raise UnsupportedWrapper(f"wrapper {wrapper.name} is not vectorised for agents with different action spaces")
    if wrapper.name == "pad_action_space_v0":
        return None
    if not isinstance(space, spaces.Box):
        raise UnsupportedWrapper(f"wrapper {wrapper.name} is vectorised for actions in a Box only")
    if wrapper.name == "clip_actions_v0":
        return lambda actions: np.clip(actions, space.low, space.high)
    scale = wrapper.kwargs["scale"]
    return lambda actions: np.asarray(actions * scale)


def _reward_change(wrapper: WrapperConfig) -> Change:
    lowest, highest = wrapper.kwargs.get("lower_bound", -1), wrapper.kwargs.get("upper_bound", 1)
    if not lowest <= 0 <= highest:
        # SuperSuit also clips the rewards between the actions of a step, which are 0.
        raise UnsupportedWrapper(f"wrapper {wrapper.name} is vectorised for bounds on both sides of 0 only")
    # The sum, as in the stock environment, turns -0.0 into 0.0.
    return lambda rewards: 0.0 + np.clip(rewards, lowest, highest)
