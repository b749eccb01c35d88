"""A wrapper of training: it shapes the rewards of Parallel environments, while matches keep the real ones."""

from typing import Any

from pettingzoo import ParallelEnv
from pettingzoo.utils import BaseParallelWrapper


class StepCost(BaseParallelWrapper):
    """Subtracts a cost from the reward of every step, so that agents hurry."""

    def __init__(self, env: ParallelEnv, cost: float = 0.01) -> None:
        super().__init__(env)
        self.cost = cost

    def step(self, actions: dict[str, Any]) -> tuple[Any, ...]:
        """Step the environment, and reduce all rewards."""
        observations, rewards, *flags = super().step(actions)
        return observations, {agent: reward - self.cost for agent, reward in rewards.items()}, *flags
