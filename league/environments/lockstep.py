"""Steps n copies of an environment in lockstep and batches their observations."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from math import isfinite
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from league.environments.copies import Copies
from league.environments.stepping import (
    BatchedEnvironment,
    Indices,
    NextEpisodes,
    States,
    Turn,
    check_actions,
    no_envs,
)
from league.environments.vector.vector_env import AgentRows
from league.errors import EnvironmentMismatch, InvalidReward


class Lockstep(BatchedEnvironment):
    """Implements BatchedEnvironment by copies, each of which has an episode or waits for one."""

    def __init__(self, copies: Copies, states: bool = False) -> None:
        super().__init__(copies.agents, len(copies.seeds))
        self.copies, self._seeds, self._seconds = copies, copies.seeds, copies.seconds
        self._gives_states = states
        self._plays = np.zeros(self.num_envs, dtype=bool)
        """Which copies have an episode."""

    def start(self, next_episodes: NextEpisodes) -> Turn:
        self._next_episodes = next_episodes
        self._plays[:] = False
        self._abandoned = self.copies.busy = no_envs()
        return self._continue(Turn(), [], np.arange(self.num_envs))

    def step(self, actions: Mapping[int, NDArray]) -> Turn:
        for group, batch in self._pending.items():
            check_actions(batch, actions[group], self.copies.actions[batch.agents[0]], self.agents)
        lost, self._abandoned = self._abandoned, no_envs()
        self._plays[lost] = False
        acting: list[AgentRows] = []
        turn = Turn()
        if self._pending:
            rows, turn.crashed = self.copies.step(self._playing(), self._pending, actions)
            acting, turn.endings = self._parted(rows)
            if len(turn.crashed):
                self._plays[turn.crashed] = False
                lost = np.union1d(lost, turn.crashed)
        turn.finished = free = (self._plays & ~self._acts(acting)).nonzero()[0]
        if len(free):
            turn.last_states = self._states(free)
            self._plays[free], self.copies.crashes[free] = False, 0
        return self._continue(turn, acting, np.union1d(free, lost) if len(lost) else free)

    @property
    def busy(self) -> Indices:
        return self.copies.busy

    def seconds(self) -> NDArray[np.float64]:
        seconds, busy = self._seconds.copy(), self.busy
        seconds[busy] += perf_counter() - self.copies.since
        return seconds

    def render(self, env: int, agent: str | None = None) -> NDArray:
        rendered = self.copies.render(env, agent)
        if rendered is None:
            raise EnvironmentMismatch("the environment cannot be rendered: it does not support render_mode 'rgb_array'")
        return np.asarray(rendered, dtype=np.uint8)

    def close(self) -> None:
        self.copies.close()

    def _continue(self, turn: Turn, acting: list[AgentRows], free: Indices) -> Turn:
        """Start the next episodes of free environments, and report who must act."""
        if len(free) and len(envs := self._starts(free)):
            first, _ = self._parted(self.copies.reset(envs))
            acts = self._acts(first)
            if not acts[envs].all():
                seed = self._seeds[envs[np.argmin(acts[envs])]]
                raise EnvironmentMismatch(f"the episode with seed {seed} ends at its reset, without an action")
            self._plays |= acts
            acting += first
        if self._gives_states:
            turn.states = self._states(self._playing())
        alike: dict[int, list[AgentRows]] = defaultdict(list)
        for block in acting:
            if len(block.envs):
                alike[self.copies.first_alike[block.agents[0]]].append(block)
        turn.batches = self._pending = self._batches(alike.values())
        return turn

    def _playing(self) -> Indices:
        return self._plays.nonzero()[0]  # faster than flatnonzero

    def _parted(self, rows: Sequence[AgentRows]) -> tuple[list[AgentRows], list[AgentRows]]:
        """Return the rows of agents that must act, and of those that have left. Raises InvalidReward."""
        acting, endings = [], []
        for block in rows:
            # The sum is cheaper, but may overflow.
            if not isfinite(block.rewards.sum()) and not (is_finite := np.isfinite(block.rewards)).all():
                row = int(np.argmin(is_finite))
                raise InvalidReward(
                    f"agent {self.agents[block.agents[row]]} got a reward of {block.rewards[row]} in the episode with"
                    f" seed {self._seeds[block.envs[row]]}, expected a finite number"
                )
            if (has_ended := block.has_ended).any():
                endings.append(block.take(has_ended.nonzero()[0]))
                block = block.take((~has_ended).nonzero()[0])
            acting.append(block)
        return acting, endings

    def _acts(self, acting: Sequence[AgentRows]) -> NDArray[np.bool_]:
        """Return in which environments an agent must act, (n,)."""
        acts = np.zeros(self.num_envs, dtype=bool)
        for block in acting:
            acts[block.envs] = True
        return acts

    def _states(self, envs: Indices) -> States | None:
        if not self._gives_states or not len(envs):
            return None
        values = self.copies.states(envs)
        return None if values is None else States(envs, values)
