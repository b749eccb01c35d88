"""Environments that a correct learner solves in seconds, one for each feature of a policy."""

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

ROUNDS = 4


class Guessing(ParallelEnv):
    """Each agent sees a task, and its reward measures how well its action solves it; after ROUNDS tasks all are
    truncated.

    action: the action space. score: (task, action) → reward of agent 0; with `opposed`, the others get its negative.
    """

    def __init__(
        self,
        observation: gymnasium.Space,
        action: gymnasium.Space,
        score: Callable[[Any, Any], float],
        agents: int = 1,
        opposed: bool = False,
    ) -> None:
        self.possible_agents = [f"player_{i}" for i in range(agents)]
        self._observation, self._action = observation, action
        self._score, self._opposed = score, opposed

    def observation_space(self, agent: str) -> gymnasium.Space:
        return self._observation

    def action_space(self, agent: str) -> gymnasium.Space:
        return self._action

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        self.agents = self.possible_agents[:]
        self._observation.seed(seed)
        self._round = 0
        return self._tasks(), {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, Any]) -> Any:
        rewards = {agent: self._score(self._task[agent], action) for agent, action in actions.items()}
        if self._opposed:
            rewards |= {agent: -reward for agent, reward in rewards.items() if agent != "player_0"}
        self._round += 1
        over = self._round == ROUNDS
        agents, self.agents = self.agents, [] if over else self.agents
        ends = dict.fromkeys(agents, over)
        return self._tasks(agents), rewards, dict.fromkeys(agents, False), ends, {agent: {} for agent in agents}

    def _tasks(self, agents: list[str] | None = None) -> dict[str, Any]:
        self._task = {agent: self._observation.sample() for agent in agents or self.agents}
        return dict(self._task)


def discrete(agents: int = 1, opposed: bool = False) -> ParallelEnv:
    """Name the number that is shown. Best return per agent: ROUNDS; with `opposed` the others name another one: 0."""
    return Guessing(
        spaces.Discrete(3), spaces.Discrete(3, start=1), lambda task, action: float(action == task + 1), agents, opposed
    )


def several(agents: int = 1) -> ParallelEnv:
    """Name two numbers that are shown, the second one reversed. Best return: ROUNDS."""
    return Guessing(
        spaces.MultiDiscrete([2, 3]),
        spaces.MultiDiscrete([2, 3]),
        lambda task, action: 0.5 * (action[0] == task[0]) + 0.5 * (action[1] == 2 - task[1]),
        agents,
    )


def numbers() -> ParallelEnv:
    """Return two numbers on another scale. Best return: 0; that of the middle of the action space is below -1."""
    scale, shift = np.array([4.0, 10.0]), np.array([0.0, 5.0])
    return Guessing(
        spaces.Box(-0.5, 0.5, (2,), np.float64),
        spaces.Box(np.array([-2, 0], np.float32), np.array([2, 10], np.float32)),
        lambda task, action: -float(np.abs((action - shift) / scale - task).mean()),
    )


def far_numbers(agents: int = 1) -> ParallelEnv:
    """Is the number above a million? The numbers differ by a few units. Best return: ROUNDS."""
    return Guessing(
        spaces.Box(999_996, 1_000_004, (1,), np.float32),
        spaces.Discrete(2),
        lambda task, action: float(action == int(task[0] > 1_000_000)),
        agents,
    )


def bits() -> ParallelEnv:
    """An action space that no policy supports."""
    return Guessing(spaces.Discrete(2), spaces.MultiBinary(2), lambda *_: 0.0)


class Watching(Guessing):
    """Two agents see a number each, and get the number that the other one sees, whatever they do."""

    def __init__(self) -> None:
        super().__init__(spaces.Discrete(3), spaces.Discrete(2), lambda *_: 0.0, agents=2)

    def step(self, actions: dict[str, Any]) -> Any:
        first, second = (float(self._task[agent]) for agent in self.possible_agents)
        observations, _, *flags = super().step(actions)
        return observations, {"player_0": second, "player_1": first}, *flags

    def state(self) -> np.ndarray:
        return np.array([self._task[agent] for agent in self.possible_agents], np.float32)


def watching() -> ParallelEnv:
    return Watching()


class Remembering(ParallelEnv):
    """A bit is shown once and must be named two steps later, without a hint. Best return: 1; without memory: 0, as a
    wrong answer costs as much as a right one earns.
    """

    LENGTH, NOTHING = 3, 2

    def __init__(self) -> None:
        self.possible_agents = ["player_0"]

    def observation_space(self, agent: str) -> gymnasium.Space:
        return spaces.Discrete(3)

    def action_space(self, agent: str) -> gymnasium.Space:
        return spaces.Discrete(2)

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        self.agents = self.possible_agents[:]
        self._bit = int(np.random.default_rng(seed).integers(2))
        self._steps = 0
        return {"player_0": self._bit}, {"player_0": {}}

    def step(self, actions: dict[str, Any]) -> Any:
        self._steps += 1
        over = self._steps == self.LENGTH
        reward = (1.0 if actions["player_0"] == self._bit else -1.0) if over else 0.0
        self.agents = [] if over else self.agents
        return (
            {"player_0": self.NOTHING},
            {"player_0": reward},
            {"player_0": over},
            {"player_0": False},
            {"player_0": {}},
        )


def remembering() -> ParallelEnv:
    return Remembering()


class Masked(ParallelEnv):
    """Each step gives the reward 1, whatever the action; after ROUNDS steps the agent is truncated. Action 1 is
    illegal, so that no learner sees its value. With a discount of γ every state has the value 1 / (1 − γ).
    """

    def __init__(self) -> None:
        self.possible_agents = ["player_0"]

    def observation_space(self, agent: str) -> gymnasium.Space:
        return spaces.Dict(
            {"observation": spaces.Box(0, 1, (1,), np.float32), "action_mask": spaces.Box(0, 1, (3,), np.int8)}
        )

    def action_space(self, agent: str) -> gymnasium.Space:
        return spaces.Discrete(3)

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        self.agents, self._steps = self.possible_agents[:], 0
        return self._seen(), {"player_0": {}}

    def step(self, actions: dict[str, Any]) -> Any:
        assert actions["player_0"] != 1, "illegal action"
        self._steps += 1
        over = self._steps == ROUNDS
        self.agents = [] if over else self.agents
        return self._seen(), {"player_0": 1.0}, {"player_0": False}, {"player_0": over}, {"player_0": {}}

    def _seen(self) -> dict[str, Any]:
        return {"player_0": {"observation": np.ones(1, np.float32), "action_mask": np.array([1, 0, 1], np.int8)}}


def masked() -> ParallelEnv:
    return Masked()


class Summing(ParallelEnv):
    """Each of two agents sees a number, and the reward of both is the negative squared difference between the sum of
    their actions and the sum of the numbers; after ROUNDS tasks all are truncated. Best return: 0; random play: about
    -1.9 a round.

    ends: the round after which player_1 alone terminates; None for never.
    """

    def __init__(self, ends: int | None = None) -> None:
        self.possible_agents = ["player_0", "player_1"]
        self._ends = ends

    def observation_space(self, agent: str) -> gymnasium.Space:
        return spaces.Box(-1, 1, (1,), np.float32)

    def action_space(self, agent: str) -> gymnasium.Space:
        return spaces.Box(-2, 2, (1,), np.float32)

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        self.agents = self.possible_agents[:]
        self._rng = np.random.default_rng(seed)
        self._round = 0
        self._draw_tasks()
        return dict(self._seen), {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, Any]) -> Any:
        error = sum(float(action[0]) for action in actions.values()) - sum(
            float(self._seen[agent][0]) for agent in actions
        )
        agents, self._round = self.agents, self._round + 1
        over = self._round == ROUNDS
        terminated = {agent: agent == "player_1" and self._round == self._ends for agent in agents}
        self._draw_tasks()
        self.agents = [] if over else [agent for agent in agents if not terminated[agent]]
        return (
            {agent: self._seen[agent] for agent in agents},
            dict.fromkeys(agents, -(error**2)),
            terminated,
            {agent: over and not terminated[agent] for agent in agents},
            {agent: {} for agent in agents},
        )

    def _draw_tasks(self) -> None:
        self._seen = {agent: self._rng.uniform(-1, 1, 1).astype(np.float32) for agent in self.possible_agents}


def summing(ends: int | None = None) -> ParallelEnv:
    return Summing(ends)
