"""A Parallel environment with images, and its vectorised version."""

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from league.config.environment import EnvironmentConfig
from league.environments.vector.vector_env import AgentRows, VectorEnv

AGENTS = ("left", "right")
STEPS = 4
PIXELS = np.arange(6 * 5 * 3).reshape(6, 5, 3)


def flicker(wrappers: Sequence[Any]) -> EnvironmentConfig:
    """The environment and its vectorised version, with wrappers."""
    return EnvironmentConfig.model_validate(
        {"entry_point": f"{__name__}:Flicker", "vector": f"{__name__}:VectorFlicker", "wrappers": wrappers}
    )


def images(seeds: NDArray, steps: NDArray, agents: NDArray, actions: NDArray) -> NDArray[np.uint8]:
    """The images of k agents, (k, 6, 5, 3). actions: the last ones of their neighbours."""
    numbers = (seeds % 7 + 1, 31 * steps + 17 * agents + 5 * actions)
    factors, offsets = (np.asarray(number).reshape(-1, 1, 1, 1) for number in numbers)
    return ((PIXELS * factors + offsets) % 256).astype(np.uint8)


class Flicker(ParallelEnv):
    """Two agents see images that depend on the seed, the step and the other agent's last action."""

    metadata: ClassVar = {"name": "flicker"}

    def __init__(self) -> None:
        self.possible_agents = list(AGENTS)
        self.agents: list[str] = []

    def observation_space(self, agent: str) -> spaces.Space:
        return spaces.Box(0, 255, (6, 5, 3), np.uint8)

    def action_space(self, agent: str) -> spaces.Space:
        return spaces.Discrete(3)

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        self.agents, self._seed, self._step = list(AGENTS), seed or 0, 0
        return self._images(dict.fromkeys(AGENTS, 0)), {agent: {} for agent in AGENTS}

    def step(self, actions: dict[str, int]) -> tuple[dict, dict, dict, dict, dict]:
        self._step += 1
        rewards = {agent: float(actions[agent]) for agent in AGENTS}
        ended = dict.fromkeys(AGENTS, self._step == STEPS)
        going_on = dict.fromkeys(AGENTS, False)
        if self._step == STEPS:
            self.agents = []
        return self._images(actions), rewards, going_on, ended, {agent: {} for agent in AGENTS}

    def _images(self, actions: dict[str, int]) -> dict[str, NDArray]:
        opposite = np.array([actions[agent] for agent in reversed(AGENTS)])
        pictures = images(np.full(2, self._seed), np.full(2, self._step), np.arange(2), opposite)
        return dict(zip(AGENTS, pictures, strict=True))


class VectorFlicker(VectorEnv):
    """Copies of Flicker."""

    possible_agents = AGENTS

    def __init__(self, num_envs: int) -> None:
        self.num_envs = num_envs
        self._seeds, self._steps = np.zeros((2, num_envs), dtype=np.int64)

    def reset(self, env_ids: NDArray[np.int64], seeds: NDArray[np.int64]) -> Sequence[AgentRows]:
        self._seeds[env_ids], self._steps[env_ids] = seeds, 0
        return self._rows(env_ids, np.zeros((len(env_ids), 2), dtype=np.int64), np.zeros(2 * len(env_ids)))

    def step(self, env_ids: NDArray[np.int64], actions: NDArray[Any]) -> Sequence[AgentRows]:
        self._steps[env_ids] += 1
        return self._rows(env_ids, actions.reshape(-1, 2), actions.astype(np.float64))

    def _rows(self, env_ids: NDArray[np.int64], actions: NDArray, rewards: NDArray) -> Sequence[AgentRows]:
        envs, agents = np.repeat(env_ids, 2), np.tile(np.arange(2), len(env_ids))
        pictures = images(self._seeds[envs], self._steps[envs], agents, actions[:, ::-1].ravel())
        return (
            AgentRows(
                envs,
                agents,
                {"observation": pictures},
                rewards,
                np.zeros(len(envs), dtype=bool),
                self._steps[envs] == STEPS,
            ),
        )
