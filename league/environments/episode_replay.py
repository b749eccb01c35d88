"""The actions of episodes in progress, and their replay in the stock environment."""

from collections import deque
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from league.config.environment import EnvironmentConfig
from league.environments.adapters import EnvAdapter, adapter_for, splitter
from league.environments.building import agent_interface, build
from league.environments.stepping import Indices
from league.environments.vector.vector_env import VectorEnv
from league.errors import no_exit
from league.spaces.arrays import environment_actions


class StepActions(NamedTuple):
    """The actions of one step, sorted by environment, then by agent: (k,), (k,), and (k,) or (k, …)."""

    envs: Indices
    agents: Indices
    actions: NDArray[Any]


class EpisodeActions:
    """The seeds and actions of all episodes in progress."""

    def __init__(self, num_envs: int) -> None:
        self._seeds = np.zeros(num_envs, np.int64)
        self._began = np.zeros(num_envs, np.int64)
        """Number of the first step of each environment's episode, counted since the start."""
        self._steps: deque[StepActions] = deque()
        self._first = 0
        """Number of the first step in `_steps`."""

    def begin(self, envs: Indices, seeds: Indices) -> None:
        """Start episodes."""
        self._seeds[envs], self._began[envs] = seeds, self._total

    def add(self, step: StepActions) -> None:
        """Add a step of all environments with an episode, and drop the steps of episodes that are over."""
        self._steps.append(step)
        oldest = int(self._began[step.envs].min())
        while self._first < oldest:
            self._steps.popleft()
            self._first += 1

    def seed(self, env: int) -> int:
        """Return the seed of an environment's episode."""
        return int(self._seeds[env])

    def in_stock(
        self, config: EnvironmentConfig, env: int, further: StepActions | None = None, render_mode: str | None = None
    ) -> EnvAdapter:
        """Replay an environment's episode in a new stock environment, which is returned. Raises what it raises.

        further: a step after the recorded ones.
        """
        stock = build(config, render_mode)
        try:
            interfaces = [agent_interface(stock, agent) for agent in stock.possible_agents]
            adapter = adapter_for(stock, [splitter(spaces.observation) for spaces in interfaces])
            with no_exit:
                adapter.reset(int(self._seeds[env]))
                for step in (*self._since(int(self._began[env])), *(() if further is None else (further,))):
                    rows = slice(*np.searchsorted(step.envs, [env, env + 1]))
                    # The agents of a vectorised environment have actions of one space, but for their bounds.
                    actions = environment_actions(step.actions[rows], interfaces[0].action)
                    adapter.step(list(zip(step.agents[rows].tolist(), actions, strict=True)))
        except BaseException:
            stock.close()
            raise
        return adapter

    def in_vector(self, vector: VectorEnv, envs: Indices) -> None:
        """Replay the episodes of some environments in a new vectorised environment."""
        began = self._began[envs]
        oldest = int(began.min(initial=self._total))
        for number, step in enumerate(self._since(oldest), oldest):
            _reset(vector, envs[began == number], self._seeds)
            playing = envs[began <= number]
            vector.step(playing, step.actions[np.isin(step.envs, playing)])
        _reset(vector, envs[began == self._total], self._seeds)

    @property
    def _total(self) -> int:
        """Number of steps since the start."""
        return self._first + len(self._steps)

    def _since(self, number: int) -> list[StepActions]:
        return list(islice(self._steps, number - self._first, None))


def _reset(vector: VectorEnv, envs: Indices, seeds: Indices) -> None:
    if len(envs):
        vector.reset(envs, seeds[envs])
