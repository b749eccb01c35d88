"""A natively batched environment that does all that the protocol allows, and remembers what it did."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from league.environments.stepping import Batch, Ending, Episode, Group, NextEpisode, Turn
from league.interface import AgentInterface, Interface
from league.seeds import generator
from league.spaces import Box, DictSpace, Discrete

ACTIONS = 3
LEAVING, ACTING, JOINING = 0.15, 0.6, 0.8
"""Chances of an agent at each step."""


@dataclass
class Seen:
    """What an agent was told in an episode, row by row, by whom it was played there, and its end."""

    groups: list[Group] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    ending: Ending | None = None


@dataclass
class Played:
    """An episode: its seed, what each agent saw, and how it went on."""

    seed: int
    agents: dict[int, Seen] = field(default_factory=dict)
    steps: int = 0
    is_lost: bool = False
    is_over: bool = False


def interface(agents: int, sides: int = 2) -> Interface:
    """Agent i is played by policy_<i mod 2>, and on side_<i mod sides>."""
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
    """Agents appear when they like, act now and then, alone or together, and leave at any time, terminated or
    truncated; a copy crashes at a step with probability `crashing`. All is drawn from the episode's seed.

    An observation is (agent, seed, rows of the agent before); one action in three is illegal.
    """

    def __init__(self, agents: int, copies: int, crashing: float = 0.0) -> None:
        self.agents = tuple(f"agent_{i}" for i in range(agents))
        self._crashing = crashing
        self._playing: list[Played] = [Played(-1)] * copies
        self._groups: list[Sequence[Group]] = [()] * copies
        self.played: dict[int, Played] = {}
        self._rows: dict[Group, tuple[list[int], list[int], list[NDArray], list[float]]] = {}
        self._waiting: dict[tuple[int, int], float] = {}

    @property
    def copies(self) -> int:
        return len(self._playing)

    def start(self, next_episode: NextEpisode) -> Turn:
        self._next_episode = next_episode
        self._rows, self._waiting = {}, {}
        for played in self._playing:
            played.is_lost = not played.is_over
        for copy in range(self.copies):
            self._begin(copy)
        return self._turn(Turn())

    def step(self, actions: Mapping[Group, NDArray]) -> Turn:
        turn = Turn()
        for group, (copies, agents, _, _) in self._rows.items():
            assert actions[group].shape == (len(copies),)
            for copy, agent, action in zip(copies, agents, actions[group].tolist(), strict=True):
                assert action - 1 != self._masked(copy, agent), "an illegal action"
        self._rows = {}
        for copy in range(self.copies):
            self._advance(copy, turn)
        return self._turn(turn)

    def assign(self, copy: int, groups: Sequence[Group]) -> None:
        self._groups[copy] = groups

    def render(self, copy: int) -> NDArray:
        raise NotImplementedError

    def close(self) -> None:
        pass

    def _begin(self, copy: int) -> None:
        episode = self._next_episode(copy)
        assert isinstance(episode, Episode)
        assert episode.seed not in self.played, "a seed that was used before"
        self._playing[copy] = self.played[episode.seed] = Played(episode.seed)
        self._groups[copy] = episode.groups
        self._report(copy, generator(episode.seed, "first"))

    def _advance(self, copy: int, turn: Turn) -> None:
        played = self._playing[copy]
        rng = generator(played.seed, played.steps)
        played.steps += 1
        if rng.random() < self._crashing:
            played.is_lost = True
            turn.crashed.append(copy)
            self._begin(copy)
            return
        for agent, seen in played.agents.items():
            if seen.ending is None:
                self._waiting[played.seed, agent] = self._waiting.get((played.seed, agent), 0.0) + int(rng.integers(9))
                if rng.random() < LEAVING:
                    seen.ending = self._ending(copy, agent, bool(rng.random() < 0.5))
                    turn.endings.append(seen.ending)
        if played.agents and all(seen.ending for seen in played.agents.values()):
            played.is_over = True
            turn.finished.append(copy)
            self._begin(copy)
        else:
            self._report(copy, rng)

    def _report(self, copy: int, rng: np.random.Generator) -> None:
        """Some agents must act, at least one; those whose name comes up for the first time join."""
        played = self._playing[copy]
        for agent in range(len(self.agents)):
            if agent not in played.agents and rng.random() < JOINING:
                played.agents[agent] = Seen()
        if not played.agents:
            played.agents[0] = Seen()
        living = [agent for agent, seen in played.agents.items() if seen.ending is None]
        acting = [agent for agent in living if rng.random() < ACTING] or living[:1]
        for agent in acting:
            group = self._groups[copy][agent]
            copies, agents, observations, rewards = self._rows.setdefault(group, ([], [], [], []))
            reward = self._waiting.pop((played.seed, agent), 0.0)
            copies.append(copy)
            agents.append(agent)
            observations.append(self._observation(copy, agent))
            rewards.append(reward)
            played.agents[agent].groups.append(group)
            played.agents[agent].rewards.append(reward)

    def _observation(self, copy: int, agent: int) -> NDArray:
        played = self._playing[copy]
        return np.array([agent, played.seed, len(played.agents[agent].groups)], np.float64)

    def _masked(self, copy: int, agent: int) -> int:
        return (agent + self._playing[copy].seed) % ACTIONS

    def _ending(self, copy: int, agent: int, terminated: bool) -> Ending:
        observation = {"observation": self._observation(copy, agent), "action_mask": np.ones(ACTIONS, np.int8)}
        reward = self._waiting.pop((self._playing[copy].seed, agent), 0.0)
        return Ending(copy, agent, observation, reward, terminated, not terminated)

    def _turn(self, turn: Turn) -> Turn:
        for group, (copies, agents, observations, rewards) in self._rows.items():
            masks = np.ones((len(copies), ACTIONS), np.int8)
            for row, (copy, agent) in enumerate(zip(copies, agents, strict=True)):
                masks[row, self._masked(copy, agent)] = 0
            arrays = {"observation": np.array(observations), "action_mask": masks}
            turn.batches[group] = Batch(copies, agents, arrays, rewards)
        return turn
