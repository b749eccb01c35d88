"""The league's environment played by its own policies, move by move, into transitions."""

import itertools
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from ray.rllib.env.single_agent_episode import SingleAgentEpisode

from league.environments.stepping import Batch, BatchedEnvironment, Episode, Turn
from league.interface import Interface
from league.spaces import ACTION_MASK, Discrete
from training.modules.actor_critic import MASKED
from training.sampling import categorical
from training.sampling.openings import Openings, RandomMover
from training.sampling.play_metrics import PlayMetrics
from training.sampling.reset_seeds import ResetSeeds
from training.sampling.transitions import Transitions

Logits = Callable[[str, dict[str, NDArray]], NDArray]
"""Policy id and observations, ONNX input name → (k, …), → masked logits (k, n) float32."""


class SelfPlay:
    """All copies of one runner. Episodes go on from one `cut` to the next."""

    def __init__(
        self,
        stepping: BatchedEnvironment,
        interface: Interface,
        seeds: ResetSeeds,
        opening_plies: int,
        rng: np.random.Generator,
    ) -> None:
        self.stepping = stepping
        self._interface = interface
        self._seeds = seeds
        self._rng = rng
        self._policies = tuple(interface.policies[agent] for agent in stepping.agents)
        self._first_action = {policy: _actions(interface, policy).start for policy in interface.policy_ids}
        self._openings = Openings(opening_plies, self._policies, stepping.copies, rng)
        self._begun = [itertools.count() for _ in range(stepping.copies)]
        self._chunk_ids = (f"{seeds.runner}-{seeds.steps}-{i}" for i in itertools.count())
        self.metrics = PlayMetrics(stepping.agents, self._policies)
        self.restart()

    def restart(self) -> None:
        """Leave the episodes that are under way, and begin new ones in all copies."""
        agents = self.stepping.agents
        self._transitions = {policy: Transitions(policy, agents) for policy in self._interface.policy_ids}
        self.metrics.forget_unfinished()
        self._turn = self.stepping.start(self._next_episode)
        self._read(self._turn)

    def step(self, logits: Logits, explore: bool) -> None:
        """One move in each copy: drawn from the distributions if `explore`, else the most probable."""
        actions = {
            group: self._open(group.policy, batch)
            if isinstance(group, RandomMover)
            else self._act(group, batch, logits, explore)
            for group, batch in self._turn.batches.items()
        }
        self._turn = self.stepping.step(actions)
        self._read(self._turn)

    @property
    def has_transitions(self) -> bool:
        """Whether a cut would bring any."""
        return any(transitions.has_closed for transitions in self._transitions.values())

    def cut(self) -> list[SingleAgentEpisode]:
        """The transitions that were closed since the last cut."""
        return [episode for transitions in self._transitions.values() for episode in transitions.cut(self._chunk_ids)]

    def uniform(self, policy: str, observations: dict[str, NDArray]) -> NDArray:
        """Logits of random legal moves."""
        rows = len(next(iter(observations.values())))
        if ACTION_MASK in observations:
            return np.where(observations[ACTION_MASK] != 0, 0.0, MASKED).astype(np.float32)
        return np.zeros((rows, _actions(self._interface, policy).n), np.float32)

    def _next_episode(self, copy: int) -> Episode:
        return Episode(self._seeds(copy, next(self._begun[copy])), self._openings.begin(copy))

    def _read(self, turn: Turn) -> None:
        for ending in turn.endings:
            transitions = self._transitions[self._policies[ending.agent]]
            self.metrics.add_agent(ending.copy, transitions.end(ending))
        for copy in turn.finished:
            self.metrics.add_episode(copy)
        for group, batch in turn.batches.items():
            if not isinstance(group, RandomMover):
                self._transitions[group].observe(batch)

    def _act(self, policy: str, batch: Batch, logits: Logits, explore: bool) -> NDArray:
        dist_inputs = logits(policy, batch.observations)
        log_p = categorical.log_softmax(dist_inputs)
        chosen = categorical.sample(log_p, self._rng) if explore else log_p.argmax(axis=-1)
        self._transitions[policy].act(chosen, log_p[np.arange(len(chosen)), chosen], dist_inputs)
        self.metrics.add_play(policy, log_p)
        return chosen + self._first_action[policy]

    def _open(self, policy: str, batch: Batch) -> NDArray:
        """Random moves of openings; the policies take over where one is over."""
        for copy in self._openings.move(batch.copies):
            self.stepping.assign(copy, self._policies)
        self.metrics.add_opening(len(batch.copies))
        log_p = categorical.log_softmax(self.uniform(policy, batch.observations))
        return categorical.sample(log_p, self._rng) + self._first_action[policy]


def _actions(interface: Interface, policy: str) -> Discrete:
    space = interface.of_policy(policy).action
    assert isinstance(space, Discrete), f"policy {policy} has actions {space}, expected Discrete"
    return space
