"""The two-step game in RLlib's API."""

from typing import Any

from ray.rllib.env.multi_agent_env import MultiAgentEnv

from policy_league.examples.two_step import TwoStep


class RLlibTwoStep(MultiAgentEnv):
    """An RLlib MultiAgentEnv: observations as in `TwoStep`; the global state is in the agents' infos."""

    def __init__(self) -> None:
        super().__init__()
        self._game = TwoStep()
        self.possible_agents = self._game.possible_agents
        self.agents: list[str] = []
        self.observation_spaces = {agent: self._game.observation_space(agent) for agent in self.possible_agents}
        self.action_spaces = {agent: self._game.action_space(agent) for agent in self.possible_agents}

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        self.agents = self.possible_agents
        return self._game.reset()[0], self._infos()

    def step(self, actions: dict[str, int]) -> tuple[dict[str, Any], ...]:
        observations, rewards, *_ = self._game.step(actions)
        return observations, rewards, {"__all__": not self._game.agents}, {"__all__": False}, self._infos()

    def _infos(self) -> dict[str, Any]:
        return {agent: {"state": self._game.state()} for agent in self.possible_agents}


def multi_agent_env() -> RLlibTwoStep:
    """The entry point for configurations."""
    return RLlibTwoStep()
