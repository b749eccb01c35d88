"""A scripted batched environment that uses everything the protocol allows, and records its episodes."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from league.environments.stepping import Batch, Ending, NextEpisodes, Turn
from league.environments.vector.vector_env import AgentRows
from league.interface import AgentInterface, Interface
from league.random.seeds import generator
from league.spaces import Box, DictSpace, Discrete

ACTIONS = 3
LEAVING, ACTING, JOINING = 0.15, 0.6, 0.8
"""Probabilities for an agent at each step."""


@dataclass
class AgentRecord:
    """The groups, rewards and ending of an agent in an episode. policies: number of the league's own."""

    policies: int
    groups: list[int] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    ending: Ending | None = None

    def is_own(self, group: int) -> bool:
        """Whether a group is a policy of the league, and not that of an opening or an opponent."""
        return group < self.policies


@dataclass
class EpisodeRecord:
    """An episode: its seed, its agents, and how it ended."""

    seed: int
    agents: dict[int, AgentRecord] = field(default_factory=dict)
    steps: int = 0
    is_lost: bool = False
    is_over: bool = False


def interface(agents: int, sides: int = 2) -> Interface:
    """Agent i has policy_<i mod 2> and side_<i mod sides>."""
    names = [f"agent_{i}" for i in range(agents)]
    spaces = AgentInterface(
        observation=DictSpace(
            spaces={
                "observation": Box(dtype="float64", shape=(3,), low=None, high=None),
                "action_mask": Box(dtype="int8", shape=(ACTIONS,), low=0, high=1),
            }
        ),
        action=Discrete(n=ACTIONS, start=1),
    )
    by_side: dict[str, list[str]] = {}
    for i, name in enumerate(names):
        by_side.setdefault(f"side_{i % sides}", []).append(name)
    return Interface(
        agents=dict.fromkeys(names, spaces),
        policies={name: f"policy_{i % 2}" for i, name in enumerate(names)},
        sides={side: tuple(members) for side, members in by_side.items()},
    )


class Scripted:
    """Agents join at random, act at some steps, alone or together, and leave at any time, terminated or truncated; an
    environment crashes at a step with probability `crashing`. All draws derive from the episode's seed.

    An observation is (agent, seed, number of the agent's earlier rows); one action in three is illegal.
    """

    def __init__(self, agents: int, num_envs: int, crashing: float = 0.0) -> None:
        self.agents = tuple(f"agent_{i}" for i in range(agents))
        self._crashing = crashing
        self._policies = min(agents, 2)
        self._playing: list[EpisodeRecord] = [EpisodeRecord(-1)] * num_envs
        self._groups = np.zeros((num_envs, agents), np.int64)
        self.played: dict[int, EpisodeRecord] = {}
        self._rows: dict[int, tuple[list[int], list[int], list[NDArray], list[float]]] = {}
        self._waiting: dict[tuple[int, int], float] = {}

    @property
    def num_envs(self) -> int:
        return len(self._playing)

    def start(self, next_episodes: NextEpisodes) -> Turn:
        self._next_episodes = next_episodes
        self._rows, self._waiting = {}, {}
        for played in self._playing:
            played.is_lost = not played.is_over
        self._begin(list(range(self.num_envs)))
        return self._turn([], [], [])

    def step(self, actions: Mapping[int, NDArray]) -> Turn:
        for group, (envs, agents, _, _) in self._rows.items():
            assert actions[group].shape == (len(envs),)
            for env, agent, action in zip(envs, agents, actions[group].tolist(), strict=True):
                assert action - 1 != self._masked(env, agent), "an illegal action"
        self._rows = {}
        endings: list[Ending] = []
        over = [self._advance(env, endings) for env in range(self.num_envs)]
        crashed, finished = (
            [env for env, how in enumerate(over) if how == outcome] for outcome in ("crashed", "finished")
        )
        self._begin(sorted(crashed + finished))
        return self._turn(endings, finished, crashed)

    def assign(self, envs: NDArray, groups: NDArray) -> None:
        self._groups[envs] = groups

    def render(self, env: int, agent: str | None = None) -> NDArray:
        raise NotImplementedError

    def close(self) -> None:
        pass

    def _begin(self, envs: list[int]) -> None:
        if not envs:
            return
        starts = self._next_episodes(np.array(envs))
        assert starts.envs.tolist() == envs
        self._groups[starts.envs] = starts.groups
        for env, seed in zip(envs, starts.seeds.tolist(), strict=True):
            assert seed not in self.played, "duplicate seed"
            self._playing[env] = self.played[seed] = EpisodeRecord(seed)
            self._report(env, generator(seed, "first"))

    def _advance(self, env: int, endings: list[Ending]) -> str:
        """Step an environment. Return whether it `crashed`, `finished` or `goes on`."""
        played = self._playing[env]
        rng = generator(played.seed, played.steps)
        played.steps += 1
        if rng.random() < self._crashing:
            played.is_lost = True
            return "crashed"
        for agent, record in played.agents.items():
            if record.ending is None:
                self._waiting[played.seed, agent] = self._waiting.get((played.seed, agent), 0.0) + int(rng.integers(9))
                if rng.random() < LEAVING:
                    record.ending = self._ending(env, agent, bool(rng.random() < 0.5))
                    endings.append(record.ending)
        if played.agents and all(record.ending for record in played.agents.values()):
            played.is_over = True
            return "finished"
        self._report(env, rng)
        return "goes on"

    def _report(self, env: int, rng: np.random.Generator) -> None:
        """A random subset of agents must act, at least one; agents drawn for the first time join."""
        played = self._playing[env]
        for agent in range(len(self.agents)):
            if agent not in played.agents and rng.random() < JOINING:
                played.agents[agent] = AgentRecord(self._policies)
        if not played.agents:
            played.agents[0] = AgentRecord(self._policies)
        alive = [agent for agent, record in played.agents.items() if record.ending is None]
        acting = [agent for agent in alive if rng.random() < ACTING] or alive[:1]
        for agent in acting:
            group = int(self._groups[env, agent])
            envs, agents, observations, rewards = self._rows.setdefault(group, ([], [], [], []))
            reward = self._waiting.pop((played.seed, agent), 0.0)
            envs.append(env)
            agents.append(agent)
            observations.append(self._observation(env, agent))
            rewards.append(reward)
            played.agents[agent].groups.append(group)
            played.agents[agent].rewards.append(reward)

    def _observation(self, env: int, agent: int) -> NDArray:
        played = self._playing[env]
        return np.array([agent, played.seed, len(played.agents[agent].groups)], np.float64)

    def _masked(self, env: int, agent: int) -> int:
        return (agent + self._playing[env].seed) % ACTIONS

    def _ending(self, env: int, agent: int, terminated: bool) -> Ending:
        observation = {"observation": self._observation(env, agent), "action_mask": np.ones(ACTIONS, np.int8)}
        reward = self._waiting.pop((self._playing[env].seed, agent), 0.0)
        return Ending(env, agent, observation, reward, terminated, not terminated)

    def _turn(self, endings: list[Ending], finished: list[int], crashed: list[int]) -> Turn:
        turn = Turn(finished=np.array(finished, np.int64), crashed=np.array(crashed, np.int64))
        turn.endings = [self._block(endings)] if endings else []
        for group, (envs, agents, observations, rewards) in sorted(self._rows.items()):
            order = np.argsort(envs, kind="stable")
            masks = np.ones((len(envs), ACTIONS), np.int8)
            for row, (env, agent) in enumerate(zip(envs, agents, strict=True)):
                masks[row, self._masked(env, agent)] = 0
            arrays = {"observation": np.array(observations), "action_mask": masks}
            turn.batches[group] = Batch(np.array(envs), np.array(agents), arrays, np.array(rewards)).rows(order)
        # Actions arrive in the order of the batches.
        self._rows = {
            group: (batch.envs.tolist(), batch.agents.tolist(), [], []) for group, batch in turn.batches.items()
        }
        return turn

    @staticmethod
    def _block(endings: list[Ending]) -> AgentRows:
        return AgentRows(
            np.array([ending.env for ending in endings]),
            np.array([ending.agent for ending in endings]),
            {name: np.stack([e.observation[name] for e in endings]) for name in endings[0].observation},
            np.array([ending.reward for ending in endings]),
            np.array([ending.terminated for ending in endings]),
            np.array([ending.truncated for ending in endings]),
        )
