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
from ray.rllib.env.multi_agent_env import MultiAgentEnv

AGENTS = ("agent_0", "agent_1")
FIRST, GAME_A, GAME_B = range(3)
STATES, ACTIONS = 3, 2
PAYOFFS = {GAME_A: np.full((2, 2), 7.0), GAME_B: np.array([[0.0, 1.0], [1.0, 8.0]])}
"""Game → (2, 2)."""


def values(gamma: float) -> NDArray:
    """Return the optimal values of action pairs, (3, 2, 2): state, first agent's action, second agent's action.

    Bellman: Q(s₁, u) = γ max Q(s₂, ·).
    """
    later = [gamma * PAYOFFS[game].max() for game in (GAME_A, GAME_B)]
    return np.stack([np.repeat(later, 2).reshape(2, 2), PAYOFFS[GAME_A], PAYOFFS[GAME_B]])


class _Game:
    """The rules, independent of the API."""

    state = FIRST

    def play(self, first: int, second: int) -> tuple[float, bool]:
        """Play both actions; return each agent's reward, and whether the episode is over."""
        if self.state == FIRST:
            self.state = GAME_A if first == 0 else GAME_B
            return 0.0, False
        return float(PAYOFFS[self.state][first, second]), True

    def one_hot(self) -> NDArray:
        """Return the one-hot state, (3,) float32; after the end, the last one."""
        return np.eye(STATES, dtype=np.float32)[self.state]


class TwoStep(ParallelEnv):
    """A PettingZoo Parallel environment. Both agents observe the one-hot state, which is also the global state."""

    metadata = {"name": "two_step", "render_modes": []}  # noqa: RUF012  # PettingZoo's name and form
    render_mode = None

    def __init__(self) -> None:
        self.possible_agents = list(AGENTS)
        self.agents: list[str] = []
        self.state_space = spaces.Box(0, 1, (STATES,), np.float32)
        self._observation, self._action = spaces.Box(0, 1, (STATES,), np.float32), spaces.Discrete(2)
        self._game = _Game()

    def observation_space(self, agent: str) -> spaces.Box:  # noqa: ARG002
        return self._observation

    def action_space(self, agent: str) -> spaces.Discrete:  # noqa: ARG002
        return self._action

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:  # noqa: ARG002
        """Reset; nothing is random."""
        self.agents, self._game = list(AGENTS), _Game()
        return self._observations(), {agent: {} for agent in AGENTS}

    def step(self, actions: dict[str, int]) -> tuple[dict[str, Any], ...]:
        reward, over = self._game.play(*(int(actions[agent]) for agent in AGENTS))
        self.agents = [] if over else self.agents
        return (
            self._observations(),
            dict.fromkeys(AGENTS, reward),
            dict.fromkeys(AGENTS, over),
            dict.fromkeys(AGENTS, False),
            {agent: {} for agent in AGENTS},
        )

    def state(self) -> NDArray:
        return self._game.one_hot()

    def _observations(self) -> dict[str, NDArray]:
        return {agent: self._game.one_hot() for agent in AGENTS}


class RLlibTwoStep(MultiAgentEnv):
    """An RLlib MultiAgentEnv: observations as above; the global state is in the agents' infos."""

    def __init__(self) -> None:
        super().__init__()
        self.possible_agents = list(AGENTS)
        self.agents: list[str] = []
        self.observation_spaces = {agent: spaces.Box(0, 1, (STATES,), np.float32) for agent in AGENTS}
        self.action_spaces = {agent: spaces.Discrete(2) for agent in AGENTS}
        self._game = _Game()

    def reset(
        self,
        *,
        seed: int | None = None,  # noqa: ARG002
        options: dict[str, Any] | None = None,  # noqa: ARG002
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Reset; nothing is random."""
        self.agents, self._game = list(AGENTS), _Game()
        return self._seen()

    def step(self, actions: dict[str, int]) -> tuple[dict[str, Any], ...]:
        reward, over = self._game.play(*(int(actions[agent]) for agent in AGENTS))
        observations, infos = self._seen()
        return observations, dict.fromkeys(AGENTS, reward), {"__all__": over}, {"__all__": False}, infos

    def _seen(self) -> tuple[dict[str, Any], dict[str, Any]]:
        state = self._game.one_hot()
        return {agent: state.copy() for agent in AGENTS}, {agent: {"state": state} for agent in AGENTS}


def parallel_env() -> TwoStep:
    """Entry point for configurations: PettingZoo's API."""
    return TwoStep()


def multi_agent_env() -> RLlibTwoStep:
    """Entry point for configurations: RLlib's API."""
    return RLlibTwoStep()
