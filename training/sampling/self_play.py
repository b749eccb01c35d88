"""The league's environment played by its own policies and their opponents, step by step, into transitions."""

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from league.environments.stepping import Batch, BatchedEnvironment, Episode, Group, Turn
from league.interface import Interface
from league.policies.actions import to_environment
from league.settings import Storage
from league.spaces import ACTION_MASK
from league.training_config import TrainingSettings
from training.modules.acting import ACTED
from training.sampling.distributions import distribution
from training.sampling.memories import Memories, State
from training.sampling.noise import OrnsteinUhlenbeck
from training.sampling.openings import Openings, RandomMover
from training.sampling.opponents import Opponents
from training.sampling.play_metrics import PlayMetrics
from training.sampling.recorder import Recorder
from training.sampling.reset_seeds import ResetSeeds
from training.sampling.seats import Opposing, Seats


@dataclass(frozen=True, slots=True)
class Ask:
    """Rows of a policy that must act: ONNX input name → (k, …), and the states of a policy with a memory."""

    observations: dict[str, NDArray]
    state: State | None


@dataclass(frozen=True, slots=True)
class Answer:
    """Inputs of the rows' distributions, (k, d) float32, and the states after."""

    dist_inputs: NDArray
    state: State | None


Think = Callable[[Mapping[str, Ask]], Mapping[str, Answer]]
"""All policies that must act, in one call: policy id → what is asked of it."""


class SelfPlay:
    """All copies of one runner. Episodes go on from one `cut` to the next. `begin` comes first."""

    def __init__(
        self,
        stepping: BatchedEnvironment,
        interface: Interface,
        settings: TrainingSettings,
        recorder: Recorder,
        initial_states: Mapping[str, Mapping[str, NDArray]],
        storage: Storage | None = None,
    ) -> None:
        """recorder: what becomes of the play of the league's own policies. initial_states: policy id → its state before
        an episode; empty for a policy without a memory.

        Raises ConfigError for opponents that there can be none of, and what loading them raises.
        """
        self._stepping, self.recorder = stepping, recorder
        self._policies = tuple(interface.policies[agent] for agent in stepping.agents)
        self._actions = {policy: interface.of_policy(policy).action for policy in interface.policy_ids}
        self._distributions = {policy: distribution(space) for policy, space in self._actions.items()}
        self._initial_states = {policy: state for policy, state in initial_states.items() if state}
        self._seats = Seats(interface, settings.opponents, stepping.agents)
        self._opponents = Opponents(settings.opponents, interface, storage)
        self.noises: dict[str, OrnsteinUhlenbeck] = {}
        """policy id → what its actions explore by, instead of independent draws."""
        self._openings = Openings(settings.opening_plies, self._policies, stepping.copies)
        self.metrics = PlayMetrics(stepping.agents, self._policies, self._distributions, stepping.copies)

    def begin(self, seeds: ResetSeeds, rng: np.random.Generator) -> None:
        """As `restart`; what comes is decided by `seeds` and `rng` alone."""
        self._seeds, self._rng = seeds, rng
        self._begun = [itertools.count() for _ in range(self._stepping.copies)]
        self.recorder.begin(seeds)
        self.restart()

    def restart(self) -> None:
        """Leave the episodes that are under way, and begin new ones in all copies."""
        self.recorder.restart()
        self._memories = {policy: Memories(initial) for policy, initial in self._initial_states.items()}
        for copy in range(self._stepping.copies):
            self.metrics.forget(copy)
            self._opponents.forget(copy)
            self._still(copy)
        self._read(self._stepping.start(self._next_episode))

    def record_by(self, recorder: Recorder) -> None:
        """Leave the episodes under way, and have another record those that begin now."""
        self.recorder = recorder
        recorder.begin(self._seeds)
        self.restart()

    def step(self, think: Think | None, explore: bool) -> None:
        """One step in each copy. think: None acts at random. explore: draw actions, instead of the most probable."""
        batches = self._turn.batches
        asks = {
            group: Ask(batch.observations, self._memories[group].before(batch) if group in self._memories else None)
            for group, batch in batches.items()
            if isinstance(group, str)
        }
        answers = think(asks) if think and asks else {}
        actions: dict[Group, NDArray] = {}
        for group, batch in batches.items():
            if isinstance(group, RandomMover):
                actions[group] = to_environment(self._random(group.policy, batch)[0], self._actions[group.policy])
            elif isinstance(group, Opposing):
                actions[group] = self._opponents.act(group, batch, self._rng)
            else:
                actions[group] = self._act(group, batch, asks[group], answers.get(group), explore)
            self.metrics.add_moves(len(batch.copies))
        for copy, seats in self._openings.step():
            self._stepping.assign(copy, seats)
        self.metrics.add_step()
        self._read(self._stepping.step(actions))

    def _next_episode(self, copy: int) -> Episode:
        seats = self._seats.draw(self._rng)
        return Episode(self._seeds(copy, next(self._begun[copy])), self._openings.begin(copy, seats, self._rng))

    def _read(self, turn: Turn) -> None:
        """Take what has ended, then what goes on or begins."""
        self._turn = turn
        self.recorder.read(turn)
        for copy in turn.crashed:
            self.metrics.add_crash(copy)
            self._forget(copy)
        for ending in turn.endings:
            self.metrics.add_agent(ending)
        for copy in turn.finished:
            self.metrics.add_episode(copy)
            self._forget(copy)
        for group, batch in turn.batches.items():
            slots = np.array(batch.copies) * len(self._policies) + np.array(batch.agents)
            rewards = np.array(batch.rewards, dtype=np.float64)
            self.metrics.add_rows(slots, rewards, are_own=isinstance(group, str))

    def _forget(self, copy: int) -> None:
        for memories in self._memories.values():
            memories.forget(copy)
        self._opponents.forget(copy)
        self._still(copy)

    def _still(self, copy: int) -> None:
        for noise in self.noises.values():
            noise.forget(copy)

    def _act(self, policy: str, batch: Batch, ask: Ask, answer: Answer | None, explore: bool) -> NDArray:
        drawing = self._distributions[policy]
        if answer is None:
            raw, dist_inputs = self._random(policy, batch)
            log_p = drawing.log_p(dist_inputs, raw)
        else:
            dist_inputs = answer.dist_inputs
            raw, log_p = self._drawn(policy, batch, dist_inputs) if explore else drawing.mode(dist_inputs)
            if answer.state is not None:
                self._memories[policy].keep(batch, _with_action(answer.state, raw))
        self.recorder.act(policy, raw, log_p, dist_inputs, ask.state)
        self.metrics.add_play(policy, dist_inputs)
        return to_environment(raw, self._actions[policy])

    def _drawn(self, policy: str, batch: Batch, dist_inputs: NDArray) -> tuple[NDArray, NDArray]:
        """Raw actions to explore by, and their log-probabilities if they were drawn independently."""
        drawing = self._distributions[policy]
        if policy not in self.noises:
            return drawing.sample(dist_inputs, self._rng)
        raw = self.noises[policy].draw(batch.copies, batch.agents, dist_inputs, self._rng)
        return raw, drawing.log_p(dist_inputs, raw)

    def _random(self, policy: str, batch: Batch) -> tuple[NDArray, NDArray]:
        """Random legal raw actions, and the inputs that stand for them."""
        mask = batch.observations.get(ACTION_MASK)
        return self._distributions[policy].uniform(mask, len(batch.copies), self._rng)


def _with_action(state: State, raw: NDArray) -> State:
    """The state after, with the action that was drawn where it is remembered."""
    return state | {ACTED: raw[:, np.newaxis].astype(np.float32) + 1} if ACTED in state else state
