"""Wraps a league's environment for plain RLlib scripts: `register(league)`, `PPOConfig().environment(league.league)`.

RLlib's own wrappers of PettingZoo report a wrong end if some agents terminate while the others are truncated, drop the
infos of a reset, only know the agents present at the first reset, and cannot render.
"""

import secrets
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from pettingzoo import AECEnv
from ray.rllib.env.multi_agent_env import MultiAgentEnv
from ray.tune.registry import register_env

from league.config.league import LeagueConfig
from league.environments.building import build, interface
from league.environments.copies import StockCopies
from league.environments.lockstep import Lockstep
from league.environments.stepping import Turn, each_agent_alone
from league.errors import EnvironmentMismatch
from league.spaces.arrays import nested
from league.spaces.conversion import to_gymnasium
from training.sampling.reset_seeds import ResetSeeds

Agents = dict[str, Any]
"""agent → value."""


def register(league: LeagueConfig) -> None:
    """Register the league's environment with RLlib and Tune under the league's name.

    Set `render_mode` (`rgb_array`) in `env_config` to render.
    """
    register_env(league.league, lambda context: LeagueEnv(league, context.get("render_mode")))


class LeagueEnv(MultiAgentEnv):
    """One environment of a league, whatever its API, including wrappers.

    Observations and actions are the environment's own, with masks. An agent has an observation when it must act, with
    the rewards since its last one, and when it leaves. The episode is over when `__all__` is set in one of the two
    dictionaries of flags. Agents truncated at that point have no flag of their own: RLlib 2.60 treats an agent with
    its own flag as terminated.
    """

    metadata: dict[str, Any]

    def __init__(self, league: LeagueConfig, render_mode: str | None = None) -> None:
        """Raises what creating the environment raises."""
        super().__init__()
        described = interface(league)
        self.metadata, self.render_mode = {}, render_mode
        self.possible_agents = list(described.agents)
        self.agents: list[str] = []
        self._observed = {agent: spaces.observation for agent, spaces in described.agents.items()}
        self.observation_spaces = {agent: to_gymnasium(space) for agent, space in self._observed.items()}
        self.action_spaces = {agent: to_gymnasium(spaces.action) for agent, spaces in described.agents.items()}
        self.observation_space = gymnasium.spaces.Dict(self.observation_spaces)
        self.action_space = gymnasium.spaces.Dict(self.action_spaces)
        self._infos = InfoRecorder(build(league.environment, render_mode))
        self._stepping = Lockstep(StockCopies(lambda: self._infos.env, 1))
        self._seeds: ResetSeeds | None = None
        self._episodes = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Agents, Agents]:  # noqa: ARG002
        """Start an episode with `seed`, or with one derived from the last given seed, or with a random one."""
        if seed is not None or self._seeds is None:
            first = secrets.randbits(64) if seed is None else seed
            self._seeds = ResetSeeds.of_run(first, runner=0, runners=1, num_envs=1, steps=0)
            self._episodes = 0
        number = self._seeds(0, self._episodes) if seed is None else seed
        self._episodes += 1
        turn = self._stepping.start(each_agent_alone([number], len(self.possible_agents)))
        if not turn.batches:
            raise EnvironmentMismatch("after reset, no agent of the environment has to act")
        observations, _, infos = self._rows(turn)
        return observations, infos

    def step(self, action_dict: Mapping[str, Any]) -> tuple[Agents, Agents, Agents, Agents, Agents]:
        """Act for each agent that had an observation. Raises IllegalAction."""
        index = self.possible_agents.index
        turn = self._stepping.step({index(agent): np.asarray(action_dict[agent])[np.newaxis] for agent in self.agents})
        observations, rewards, infos = self._rows(turn)
        terminated, truncated = dict.fromkeys(observations, False), dict.fromkeys(observations, False)
        is_over = not turn.batches
        endings = list(turn.each_ending())
        for ending in endings:
            agent = self.possible_agents[ending.agent]
            observations[agent] = nested(self._observed[agent], ending.observation)
            rewards[agent] = ending.reward
            infos[agent] = self._infos.of(agent)
            terminated[agent] = ending.terminated
            truncated[agent] = ending.truncated and not is_over
        is_cut = is_over and any(not ending.terminated for ending in endings)
        terminated["__all__"], truncated["__all__"] = is_over and not is_cut, is_cut
        return observations, rewards, terminated, truncated, infos

    def render(self) -> Any:
        """Return (height, width, 3) uint8. Raises EnvironmentMismatch without `render_mode`."""
        return self._stepping.render(0)

    def close(self) -> None:
        """Close the environment."""
        self._stepping.close()

    def _rows(self, turn: Turn) -> tuple[Agents, Agents, Agents]:
        """Return observations, rewards and infos of the agents that must act, in the order of `possible_agents`."""
        rows = {self.possible_agents[group]: batch for group, batch in turn.batches.items()}
        self.agents = list(rows)
        return (
            {
                agent: nested(self._observed[agent], {name: array[0] for name, array in batch.observations.items()})
                for agent, batch in rows.items()
            },
            {agent: float(batch.rewards[0]) for agent, batch in rows.items()},
            {agent: self._infos.of(agent) for agent in rows},
        )


class InfoRecorder:
    """Keeps an environment's latest infos: an AECEnv stores them, other APIs only return them."""

    def __init__(self, env: Any) -> None:
        self.env = env
        self._last: Mapping[str, Any] = {}
        if not isinstance(env, AECEnv):
            env.reset, env.step = self._kept(env.reset), self._kept(env.step)

    def of(self, agent: str) -> dict[str, Any]:
        """Return an agent's infos; empty for an agent that an AECEnv has removed."""
        infos = self.env.infos if isinstance(self.env, AECEnv) else self._last
        return dict(infos.get(agent, {}))

    def _kept(self, call: Any) -> Any:
        def keeping(*args: Any, **kwargs: Any) -> Any:
            answer = call(*args, **kwargs)
            self._last = answer[-1]
            return answer

        return keeping
