"""What becomes of play: the protocol of those who record it, and the one who records episodes for PPO."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from ray.rllib.env.single_agent_episode import SingleAgentEpisode

from league.environments.stepping import Turn
from league.interface import Interface
from training.sampling.reset_seeds import ResetSeeds
from training.sampling.transitions import Transitions


class Recorder(Protocol):
    """Is told of each turn, then of what the league's own policies do in it. Groups of turns that are no policy ids are
    played by others, and nothing is learned from them."""

    def begin(self, seeds: ResetSeeds) -> None:
        """A new stretch of play begins; `restart` follows."""
        ...

    def restart(self) -> None:
        """All episodes under way are left, and their open transitions forgotten."""
        ...

    def read(self, turn: Turn) -> None:
        """What the last step brought, and who must act next."""
        ...

    def act(
        self, policy: str, raw: NDArray, log_p: NDArray, dist_inputs: NDArray, state: Mapping[str, NDArray] | None
    ) -> None:
        """What was done on the rows of a policy in the last turn: raw actions (k,) or (k, m), (k,), (k, d), and the
        states before of a policy with a memory, key → (k, width)."""
        ...


class Chunks:
    """Records chunks of episodes, one agent's steps each."""

    def __init__(self, interface: Interface, agents: Sequence[str], copies: int) -> None:
        self._agents, self._copies = tuple(agents), copies
        self._policies = tuple(interface.policies[agent] for agent in agents)
        self._learning = interface.policy_ids
        self._ids: Iterator[str] = iter(())

    def begin(self, seeds: ResetSeeds) -> None:
        self._ids = (f"{seeds.runner}-{seeds.steps}-{i}" for i in itertools.count())

    def restart(self) -> None:
        self._transitions = {policy: Transitions(policy, self._agents, self._copies) for policy in self._learning}

    def read(self, turn: Turn) -> None:
        for copy in turn.crashed:
            for transitions in self._transitions.values():
                transitions.lose(copy)
        for ending in turn.endings:
            slot = ending.copy * len(self._agents) + ending.agent
            self._transitions[self._policies[ending.agent]].end(slot, ending)
        for group, batch in turn.batches.items():
            if isinstance(group, str):
                slots = np.array(batch.copies) * len(self._agents) + np.array(batch.agents)
                rewards = np.array(batch.rewards, dtype=np.float64)
                self._transitions[group].observe(slots, rewards, batch.observations)

    def act(
        self, policy: str, raw: NDArray, log_p: NDArray, dist_inputs: NDArray, state: Mapping[str, NDArray] | None
    ) -> None:
        self._transitions[policy].act(raw, log_p, dist_inputs, state)

    def cut(self) -> list[SingleAgentEpisode]:
        """The transitions that were closed since the last cut."""
        return [chunk for transitions in self._transitions.values() for chunk in transitions.cut(self._ids)]
