"""The two-step game of the QMIX paper: two cooperating agents whose value is not a sum of agent values.

In the first step, the first agent selects one of two matrix games; the other agent's action has no effect. The second
step pays both agents equally by both actions, and ends the episode.

| game | payoffs, row: action of the first agent, column: of the second |
|---|---|
| A | 7 everywhere |
| B | 0 1 / 1 8 |

Optimal play selects B and then the second action twice: 8. Agents whose values are added underestimate B
(Rashid et al., 2018, arXiv 1803.11485, section 5).
"""

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

AGENTS = ("agent_0", "agent_1")
FIRST, GAME_A, GAME_B = range(3)
STATES, ACTIONS = 3, 2
PAYOFFS = {GAME_A: np.full((2, 2), 7.0), GAME_B: np.array([[0.0, 1.0], [1.0, 8.0]])}
"""Game → (2, 2)."""


class TwoStep(ParallelEnv):
    """A PettingZoo Parallel environment. Both agents observe the one-hot state, which is also the global state."""

    metadata = {"name": "two_step", "render_modes": []}  # noqa: RUF012  # PettingZoo's name and form
    render_mode = None

    def __init__(self) -> None:
        self.possible_agents = list(AGENTS)
        self.agents: list[str] = []
        self.state_space = spaces.Box(0, 1, (STATES,), np.float32)
        self._observation, self._action = spaces.Box(0, 1, (STATES,), np.float32), spaces.Discrete(ACTIONS)
        self._state = FIRST

    def observation_space(self, agent: str) -> spaces.Box:  # noqa: ARG002
        return self._observation

    def action_space(self, agent: str) -> spaces.Discrete:  # noqa: ARG002
        return self._action

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:  # noqa: ARG002
        """Reset; nothing is random."""
        self.agents, self._state = list(AGENTS), FIRST
        return self._observations(), {agent: {} for agent in AGENTS}

    def step(self, actions: dict[str, int]) -> tuple[dict[str, Any], ...]:
        first, second = (int(actions[agent]) for agent in AGENTS)
        over = self._state != FIRST
        reward = float(PAYOFFS[self._state][first, second]) if over else 0.0
        if over:
            self.agents = []
        else:
            self._state = GAME_B if first else GAME_A
        return (
            self._observations(),
            dict.fromkeys(AGENTS, reward),
            dict.fromkeys(AGENTS, over),
            dict.fromkeys(AGENTS, False),
            {agent: {} for agent in AGENTS},
        )

    def state(self) -> NDArray:
        """Return the one-hot state, (3,) float32; after the end, the last one."""
        return np.eye(STATES, dtype=np.float32)[self._state]

    def _observations(self) -> dict[str, NDArray]:
        return {agent: self.state() for agent in AGENTS}


def parallel_env() -> TwoStep:
    """Entry point for configurations: PettingZoo's API."""
    return TwoStep()
