"""A small AEC environment in which all values differ by player, so that a wrong index is detected."""

from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import AECEnv
from pettingzoo.utils import AgentSelector


class Counting(AECEnv):
    """Players take turns for `lives[i]` turns each; player i then terminates, or is truncated if i is in `truncated`.

    Player i's observation is (i, number of its turns, seed of the reset modulo 97). Each move of any player gives
    player i the reward 10^i, which distinguishes the rewards of different players.
    """

    metadata = {"name": "counting_v0", "render_modes": []}  # noqa: RUF012  PettingZoo declares it like this

    def __init__(self, lives: tuple[int, ...] = (3, 3), truncated: tuple[int, ...] = ()) -> None:
        super().__init__()
        self.lives = lives
        self.cut = truncated
        self.possible_agents = [f"player_{index}" for index in range(len(lives))]
        self.render_mode = None

    def observation_space(self, agent: str) -> spaces.Space:
        return spaces.Box(0, 1000, (3,), np.float32)

    def action_space(self, agent: str) -> spaces.Space:
        return spaces.Discrete(2 + self.possible_agents.index(agent))

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        self.agents = self.possible_agents[:]
        self.rewards = dict.fromkeys(self.agents, 0.0)
        self._cumulative_rewards = dict.fromkeys(self.agents, 0.0)
        self.terminations = dict.fromkeys(self.agents, False)
        self.truncations = dict.fromkeys(self.agents, False)
        self.infos = {agent: {} for agent in self.agents}
        self.turns = dict.fromkeys(self.agents, 0)
        self.seed = seed or 0
        # The buffer is reused: a caller that keeps a reference instead of a copy sees it change.
        self.buffer = np.zeros(3, np.float32)
        self._selector = AgentSelector(self.agents)
        self.agent_selection = self._selector.reset()

    def observe(self, agent: str) -> np.ndarray:
        self.buffer[:] = (self.possible_agents.index(agent), self.turns.get(agent, -1), self.seed % 97)
        return self.buffer

    def step(self, action: int | None) -> None:
        agent = self.agent_selection
        if self.terminations[agent] or self.truncations[agent]:
            self._was_dead_step(action)
            return
        self._cumulative_rewards[agent] = 0.0
        self.turns[agent] += 1
        index = self.possible_agents.index(agent)
        if self.turns[agent] == self.lives[index]:
            (self.truncations if index in self.cut else self.terminations)[agent] = True
        self.rewards = {other: 10.0 ** self.possible_agents.index(other) for other in self.agents}
        self._accumulate_rewards()
        alive = [other for other in self.agents if not (self.terminations[other] or self.truncations[other])]
        if alive:
            order = self.possible_agents
            candidates = order[index + 1 :] + order[: index + 1]
            self.agent_selection = next(other for other in candidates if other in alive)
        self._deads_step_first()


def counting(lives: list[int] | None = None, truncated: list[int] | None = None) -> Counting:
    """The entry point for configurations."""
    return Counting(tuple(lives or (3, 3)), tuple(truncated or ()))
