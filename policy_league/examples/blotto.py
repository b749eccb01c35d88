"""Colonel Blotto: both players divide ten coins among three fields at the same time. A PettingZoo parallel environment.

More coins win a field, and more fields win the game: 1, -1, or 0 for a draw. An action is one of the 66 divisions.
There is nothing to observe, and each pure strategy loses against another one, so that only a mixed policy is not
exploitable (É. Borel, 1921, "La théorie du jeu et les équations intégrales à noyau symétrique").
"""

from itertools import product
from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

AGENTS = ("player_0", "player_1")
COINS, FIELDS = 10, 3
DIVISIONS = np.array([coins for coins in product(range(COINS + 1), repeat=FIELDS) if sum(coins) == COINS])
"""Coins on each field, (actions, fields)."""
PAYOFF = np.sign(np.sign(DIVISIONS[:, np.newaxis] - DIVISIONS).sum(axis=2)).astype(np.float64)
"""What an action wins against each other one, (actions, actions)."""


class Blotto(ParallelEnv):
    """One game is an episode of one step. The observation is constant, (1,) float32."""

    metadata = {"name": "blotto", "render_modes": []}  # noqa: RUF012  # PettingZoo's name and form
    render_mode = None

    def __init__(self) -> None:
        self.possible_agents = list(AGENTS)
        self.agents: list[str] = []
        self._observation = spaces.Box(0, 1, (1,), np.float32)
        self._action = spaces.Discrete(len(DIVISIONS))

    def observation_space(self, agent: str) -> spaces.Box:  # noqa: ARG002
        return self._observation

    def action_space(self, agent: str) -> spaces.Discrete:  # noqa: ARG002
        return self._action

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:  # noqa: ARG002
        self.agents = list(AGENTS)
        return _each(np.zeros(1, np.float32)), {agent: {} for agent in AGENTS}

    def step(self, actions: dict[str, int]) -> tuple[dict, dict, dict, dict, dict]:
        gain = float(PAYOFF[tuple(int(actions[agent]) for agent in AGENTS)])
        self.agents = []
        rewards = dict(zip(AGENTS, (gain, -gain), strict=True))
        return _each(np.zeros(1, np.float32)), rewards, _each(True), _each(False), {agent: {} for agent in AGENTS}


def _each(value: Any) -> dict[str, Any]:
    return dict.fromkeys(AGENTS, value)


def env() -> Blotto:
    """Entry point for configurations."""
    return Blotto()
