"""Games of five moves with masks in Dict observations, for all APIs. They raise if an action is illegal."""

from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import AECEnv, ParallelEnv
from ray.rllib.env.multi_agent_env import MultiAgentEnv

BOX = spaces.Box(-1, 1, (2,), np.float32)
DISCRETE, MULTI = spaces.Discrete(3), spaces.MultiDiscrete([2, 3])
OBSERVATIONS = {
    "obs": spaces.Dict({"obs": BOX, "action_mask": spaces.Box(0, 1, (3,), np.int8)}),
    "nested": spaces.Dict({"real": spaces.Dict({"a": BOX, "b": BOX}), "action_mask": spaces.MultiBinary(3)}),
    "secret": spaces.Dict({"observation": BOX, "secret": BOX, "action_mask": spaces.Box(0, 1, (3,), np.float32)}),
    "multi": spaces.Dict({"observations": BOX, "action_mask": spaces.MultiDiscrete([2] * 5)}),
    "joint": spaces.Dict({"observation": BOX, "action_mask": spaces.MultiBinary((2, 3))}),
    "short": spaces.Dict({"observation": BOX, "action_mask": spaces.MultiBinary(2)}),
    "parts": spaces.Dict({"observation": BOX, "action_mask": spaces.Dict({"a": spaces.MultiBinary(3)})}),
    "only": spaces.Dict({"action_mask": spaces.MultiBinary(3)}),
}
ACTIONS = {"multi": MULTI, "joint": MULTI}
AGENTS = ["ann", "bob"]


class Masked:
    """A game of five moves. The mask forbids the second action, or the second value of each element."""

    def __init__(self, space: str, continuous: bool = False) -> None:
        self.metadata: dict[str, Any] = {"name": "masked", "is_parallelizable": True}
        self.possible_agents, self.agents, self.render_mode = AGENTS, AGENTS, None
        self.observed = OBSERVATIONS[space]
        self.acted = spaces.Box(-1, 1, (3,), np.float32) if continuous else ACTIONS.get(space, DISCRETE)
        self.observation_spaces, self.action_spaces = (
            dict.fromkeys(AGENTS, kind_of_space) for kind_of_space in (self.observed, self.acted)
        )

    def observation_space(self, agent: str) -> Any:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Any:
        return self.action_spaces[agent]

    def value(self, space: Any = None, key: str = "") -> Any:
        space = space or self.observed
        if isinstance(space, spaces.Dict):
            return {key: self.value(part, key) for key, part in space.spaces.items()}
        if key == "action_mask":
            choices = [3] if space.shape == (3,) else [2, 3]
            mask = np.concatenate([np.arange(n) != 1 for n in choices])
            return np.resize(mask, space.shape).astype(space.dtype)
        return self.rng.uniform(-1, 1, space.shape).astype(space.dtype)

    def begin(self, seed: int | None) -> None:
        self.agents, self.turn, self.rng = list(AGENTS), 0, np.random.default_rng(seed)

    def move(self, action: Any) -> None:
        self.turn += 1
        assert type(action) is type(self.acted.sample()), f"{action!r} is not what sample returns"
        if isinstance(self.acted, spaces.Discrete | spaces.MultiDiscrete):
            assert 1 not in np.ravel(action), f"illegal action {action}"


class ParallelMasked(Masked, ParallelEnv):
    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        self.begin(seed)
        return {agent: self.value() for agent in AGENTS}, {agent: {} for agent in AGENTS}

    def step(self, actions: dict[str, Any]) -> Any:
        for action in actions.values():
            self.move(action)
        over = self.turn >= 10
        self.agents = [] if over else AGENTS
        values = {agent: self.value() for agent in AGENTS}, dict.fromkeys(AGENTS, 1.0)
        return *values, dict.fromkeys(AGENTS, over), dict.fromkeys(AGENTS, False), {agent: {} for agent in AGENTS}


class TurnMasked(Masked, AECEnv):
    def reset(self, seed: int | None = None, options: Any = None) -> None:
        self.begin(seed)
        self.rewards, self._cumulative_rewards = dict.fromkeys(AGENTS, 1.0), dict.fromkeys(AGENTS, 0.0)
        self.terminations, self.truncations = dict.fromkeys(AGENTS, False), dict.fromkeys(AGENTS, False)
        self.infos: dict[str, Any] = {agent: {} for agent in AGENTS}
        self.agent_selection, self.last_value = AGENTS[0], self.value()

    def observe(self, agent: str) -> Any:
        return self.last_value

    def step(self, action: Any) -> None:
        if self.terminations[self.agent_selection]:
            self._was_dead_step(action)
            return
        self.move(action)
        self._cumulative_rewards[self.agent_selection] = 0.0
        self.terminations = dict.fromkeys(AGENTS, self.turn >= 10)
        self.last_value, self.agent_selection = self.value(), AGENTS[self.turn % 2]
        self._accumulate_rewards()


class RLlibMasked(Masked, MultiAgentEnv):
    def __init__(self, **kwargs: Any) -> None:
        MultiAgentEnv.__init__(self)
        Masked.__init__(self, **kwargs)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.begin(seed)
        return {agent: self.value() for agent in AGENTS}, {}

    def step(self, actions: dict[str, Any]) -> Any:
        for action in actions.values():
            self.move(action)
        values = {agent: self.value() for agent in AGENTS}, dict.fromkeys(AGENTS, 1.0)
        return *values, {"__all__": self.turn >= 10}, {"__all__": False}, {}


APIS = ("ParallelMasked", "TurnMasked", "RLlibMasked")
