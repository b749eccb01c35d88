"""A Parallel environment whose agents' observations are transformed together, in place of a stack of SuperSuit's."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import ParallelEnv
from pettingzoo.utils import BaseParallelWrapper

from league.config import WrapperConfig
from league.environments.transforms import Transform, channel, transform


class BatchedWrappers(BaseParallelWrapper):
    """As the wrappers that it stands for, exactly, but that all agents' observations are transformed at once."""

    def __init__(
        self,
        env: ParallelEnv,
        view: Callable[[NDArray], NDArray] | None,
        transforms: Sequence[Transform],
        observed: Sequence[spaces.Space[Any]],
    ) -> None:
        """view: what is taken of each observation before they are put together, None for all of it.
        observed: what each agent observes in the end."""
        super().__init__(env)
        self._index = {agent: index for index, agent in enumerate(env.possible_agents)}
        self._view, self._transforms, self._observed = view, transforms, observed

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        return self._observed[self._index[agent]]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, Any], Any]:
        observations, infos = self.env.reset(seed=seed, options=options)
        for each in self._transforms:
            each.reset()
        return self._transformed(observations), infos

    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], Any, Any, Any, Any]:
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        return self._transformed(observations), rewards, terminated, truncated, infos

    def _transformed(self, observations: Mapping[str, NDArray]) -> dict[str, NDArray]:
        if not observations:
            return {}
        agents = np.array([self._index[agent] for agent in observations])
        values = observations.values() if self._view is None else map(self._view, observations.values())
        rows = np.array(list(values))
        for each in self._transforms:
            rows = each(rows, agents)
        return dict(zip(observations, rows, strict=True))


def batched(
    env: ParallelEnv, wrappers: Sequence[WrapperConfig], spaces_before: Sequence[Sequence[spaces.Space[Any]]]
) -> ParallelEnv | None:
    """`env` with `wrappers` for all agents at once; None where one of them, or a space, is none that we batch.

    spaces_before[i]: what the agents observe before wrapper i, by SuperSuit's own account; the last entry is what they
    observe after all of them.
    """
    transforms = []
    for wrapper, before in zip(wrappers, spaces_before, strict=False):
        space = before[0]
        if not isinstance(space, spaces.Box) or any(other != space for other in before):
            return None
        made = transform(wrapper.name, wrapper.kwargs, space, env.possible_agents)
        if made is None:
            return None
        transforms.append(made)
    view = channel(**wrappers[0].kwargs) if wrappers[0].name == "color_reduction_v0" else None
    return BatchedWrappers(env, view, transforms[view is not None :], spaces_before[-1])
