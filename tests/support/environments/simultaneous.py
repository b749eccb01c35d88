"""Small environments in which all agents act at once: PettingZoo's Parallel API and RLlib's.

Agent i is present from step `arrives[i]` (first an observation, then an action) and leaves at step `leaves[i]`:
terminated, or truncated if i is in `truncated`. It observes (i, step, seed modulo 97) and gets the reward 10^i in each
step in which it acts.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv


class Simultaneous(ParallelEnv):
    """PettingZoo's Parallel API. `crashes`: seeds whose episode raises at step 2; `bad_reward`: agent 0's reward."""

    metadata = {"name": "meeting_v0", "render_modes": []}  # noqa: RUF012  PettingZoo declares it like this

    def __init__(
        self,
        arrives: Sequence[int] = (0, 0),
        leaves: Sequence[int] = (3, 3),
        truncated: Sequence[int] = (),
        crashes: Sequence[int] = (),
        bad_reward: float | None = None,
    ) -> None:
        self.arrives, self.leaves, self.cut = tuple(arrives), tuple(leaves), frozenset(truncated)
        self.crashes, self.bad_reward = frozenset(crashes), bad_reward
        self.possible_agents = [f"agent_{i}" for i in range(len(self.leaves))]
        self.agents: list[str] = []
        self.render_mode = None

    def observation_space(self, agent: str) -> spaces.Space:
        return spaces.Box(0, 1000, (3,), np.float32)

    def action_space(self, agent: str) -> spaces.Space:
        return spaces.Discrete(2 + self.possible_agents.index(agent))

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        self.time, self.seed = 0, seed or 0
        self.agents = self._present()
        return {agent: self._observe(agent) for agent in self.agents}, {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, int]) -> tuple[dict, ...]:
        assert set(actions) == set(self.agents), "each present agent acts"
        acted = self.agents
        self.time += 1
        if self.time == 2 and self.seed in self.crashes:
            raise RuntimeError("the simulator is gone")
        rewards = {agent: 10.0 ** self.possible_agents.index(agent) for agent in acted}
        if self.bad_reward is not None and "agent_0" in rewards:
            rewards["agent_0"] = self.bad_reward
        leaving = [agent for agent in acted if self.leaves[self.possible_agents.index(agent)] == self.time]
        truncated = {agent: self.possible_agents.index(agent) in self.cut for agent in leaving}
        self.agents = self._present()
        observations = {agent: self._observe(agent) for agent in (*leaving, *self.agents)}
        flags = dict.fromkeys(observations, False)
        terminated = flags | {agent: not truncated[agent] for agent in leaving}
        return observations, rewards, terminated, flags | truncated, {agent: {} for agent in observations}

    def _present(self) -> list[str]:
        stays = zip(self.possible_agents, self.arrives, self.leaves, strict=True)
        return [agent for agent, arrives, leaves in stays if arrives <= self.time < leaves]

    def _observe(self, agent: str) -> np.ndarray:
        return np.array([self.possible_agents.index(agent), self.time, self.seed % 97], np.float32)


class RLlibSimultaneous:
    """RLlib's MultiAgentEnv API by duck typing: agents left at the end of the episode have no flag but `__all__`."""

    def __init__(self, ends: int = 3, truncated: bool = True, silent: bool = False) -> None:
        """silent: the last step has no observation."""
        self.ends, self.cut, self.silent = ends, truncated, silent
        self.possible_agents = ["agent_0", "agent_1"]
        self.observation_spaces = dict.fromkeys(self.possible_agents, spaces.Box(0, 1000, (2,), np.float32))
        self.action_spaces = dict.fromkeys(self.possible_agents, spaces.Discrete(3))

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        self.time = 0
        self.buffer = np.zeros(2, np.float32)
        return {"agent_0": self._observe()}, {}

    def step(self, actions: dict[str, int]) -> tuple[dict, ...]:
        # The two take turns: the agent with an observation acts next.
        self.time += 1
        is_over = self.time == self.ends
        observations = {} if is_over and self.silent else {f"agent_{self.time % 2}": self._observe()}
        rewards = {"agent_0": 1.0, "agent_1": 10.0}
        return observations, rewards, {"__all__": is_over and not self.cut}, {"__all__": is_over and self.cut}, {}

    def close(self) -> None:
        pass

    def _observe(self) -> np.ndarray:
        self.buffer[:] = (self.time % 2, self.time)
        return self.buffer


def meeting(**kwargs: Any) -> Simultaneous:
    """The entry point for configurations."""
    return Simultaneous(**kwargs)


def rllib_meeting(**kwargs: Any) -> RLlibSimultaneous:
    """The entry point for configurations."""
    return RLlibSimultaneous(**kwargs)
