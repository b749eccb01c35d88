"""Plays the league's policies against each other and opponents, step by step, and records transitions."""

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from league.environments.stepping import Batch, BatchedEnvironment, EpisodeStart, Group, Turn
from league.interface import Interface
from league.policies.actions import to_environment
from league.settings import Storage
from league.spaces import ACTION_MASK
from league.training_config import TrainingSettings
from training.modules.policy_module import PREVIOUS_ACTION
from training.sampling.distributions import OrnsteinUhlenbeck, distribution
from training.sampling.opponents import Matchups, Openings, OpponentPolicy, Opponents, RandomMoves
from training.sampling.play_metrics import PlayMetrics
from training.sampling.recorder import Recorder
from training.sampling.recurrent_state import RecurrentStates, State
from training.sampling.reset_seeds import ResetSeeds


@dataclass(frozen=True, slots=True)
class ForwardInput:
    """Rows of a policy that must act: ONNX input name → (k, …), and recurrent states if it has any."""

    observations: dict[str, NDArray]
    state: State | None


@dataclass(frozen=True, slots=True)
class ForwardOutput:
    """Distribution inputs (k, d) float32, and the recurrent states after the step."""

    dist_inputs: NDArray
    state: State | None


Forward = Callable[[Mapping[str, ForwardInput]], Mapping[str, ForwardOutput]]
"""One forward pass for all policies that must act: policy id → its rows."""


class SelfPlay:
    """Plays all environments of one runner. Call `begin` first. Episodes continue across the recorder's cuts."""

    def __init__(
        self,
        stepping: BatchedEnvironment,
        interface: Interface,
        settings: TrainingSettings,
        recorder: Recorder,
        initial_states: Mapping[str, Mapping[str, NDArray]],
        storage: Storage | None = None,
    ) -> None:
        """recorder: receives the play of the league's own policies. initial_states: policy id → initial recurrent
        state, empty if not recurrent.

        Raises ConfigError for invalid opponents, and what loading them raises.
        """
        self._stepping, self.recorder = stepping, recorder
        self._policies = tuple(interface.policies[agent] for agent in stepping.agents)
        self._actions = {policy: interface.of_policy(policy).action for policy in interface.policy_ids}
        self._distributions = {policy: distribution(space) for policy, space in self._actions.items()}
        self._initial_states = {policy: state for policy, state in initial_states.items() if state}
        self._matchups = Matchups(interface, settings.opponents, stepping.agents)
        self._opponents = Opponents(settings.opponents, interface, storage)
        self.noises: dict[str, OrnsteinUhlenbeck] = {}
        """policy id → temporally correlated exploration noise, instead of independent draws."""
        self._openings = Openings(settings.opening_plies, self._policies, stepping.num_envs)
        self.metrics = PlayMetrics(stepping.agents, self._policies, self._distributions, stepping.num_envs)

    def begin(self, seeds: ResetSeeds, rng: np.random.Generator) -> None:
        """Restart; all further play is determined by `seeds` and `rng`."""
        self._seeds, self._rng = seeds, rng
        self._begun = [itertools.count() for _ in range(self._stepping.num_envs)]
        self.recorder.begin(seeds)
        self.restart()

    def restart(self) -> None:
        """Drop all open episodes, and start new ones in all environments."""
        self.recorder.restart()
        self._recurrent_states = {policy: RecurrentStates(initial) for policy, initial in self._initial_states.items()}
        for env in range(self._stepping.num_envs):
            self.metrics.forget(env)
            self._opponents.forget(env)
            self._reset_noise(env)
        self._read(self._stepping.start(self._next_episode))

    def record_by(self, recorder: Recorder) -> None:
        """Drop all open episodes, and let another recorder record the following ones."""
        self.recorder = recorder
        recorder.begin(self._seeds)
        self.restart()

    def step(self, forward: Forward | None, explore: bool) -> None:
        """Take a step in each environment. forward: None for random actions. explore: sample instead of taking the
        mode."""
        batches = self._turn.batches
        forward_inputs = {
            group: ForwardInput(
                batch.observations,
                self._recurrent_states[group].get(batch) if group in self._recurrent_states else None,
            )
            for group, batch in batches.items()
            if isinstance(group, str)
        }
        outputs = forward(forward_inputs) if forward and forward_inputs else {}
        actions: dict[Group, NDArray] = {}
        for group, batch in batches.items():
            if isinstance(group, RandomMoves):
                actions[group] = to_environment(self._random(group.policy, batch)[0], self._actions[group.policy])
            elif isinstance(group, OpponentPolicy):
                actions[group] = self._opponents.act(group, batch, self._rng)
            else:
                actions[group] = self._act(group, batch, forward_inputs[group], outputs.get(group), explore)
            self.metrics.add_moves(len(batch.envs))
        for env, controllers in self._openings.step():
            self._stepping.assign(env, controllers)
        self.metrics.add_step()
        self._read(self._stepping.step(actions))

    def _next_episode(self, env: int) -> EpisodeStart:
        controllers = self._matchups.draw(self._rng)
        return EpisodeStart(self._seeds(env, next(self._begun[env])), self._openings.begin(env, controllers, self._rng))

    def _read(self, turn: Turn) -> None:
        """Process what has ended, then what continues or starts."""
        self._turn = turn
        self.recorder.read(turn)
        for env in turn.crashed:
            self.metrics.add_crash(env)
            self._forget(env)
        for ending in turn.endings:
            self.metrics.add_agent(ending)
        for env in turn.finished:
            self.metrics.add_episode(env)
            self._forget(env)
        for group, batch in turn.batches.items():
            slots = np.array(batch.envs) * len(self._policies) + np.array(batch.agents)
            rewards = np.array(batch.rewards, dtype=np.float64)
            self.metrics.add_rows(slots, rewards, are_own=isinstance(group, str))

    def _forget(self, env: int) -> None:
        for states in self._recurrent_states.values():
            states.forget(env)
        self._opponents.forget(env)
        self._reset_noise(env)

    def _reset_noise(self, env: int) -> None:
        for noise in self.noises.values():
            noise.forget(env)

    def _act(
        self, policy: str, batch: Batch, forward_input: ForwardInput, output: ForwardOutput | None, explore: bool
    ) -> NDArray:
        drawing = self._distributions[policy]
        if output is None:
            raw, dist_inputs = self._random(policy, batch)
            log_p = drawing.log_p(dist_inputs, raw)
        else:
            dist_inputs = output.dist_inputs
            raw, log_p = self._drawn(policy, batch, dist_inputs) if explore else drawing.mode(dist_inputs)
            if output.state is not None:
                self._recurrent_states[policy].update(batch, _with_previous_action(output.state, raw))
        self.recorder.act(policy, raw, log_p, dist_inputs, forward_input.state)
        self.metrics.add_play(policy, dist_inputs)
        return to_environment(raw, self._actions[policy])

    def _drawn(self, policy: str, batch: Batch, dist_inputs: NDArray) -> tuple[NDArray, NDArray]:
        """Return raw exploring actions, and their log-probabilities under independent sampling."""
        drawing = self._distributions[policy]
        if policy not in self.noises:
            return drawing.sample(dist_inputs, self._rng)
        raw = self.noises[policy].draw(batch.envs, batch.agents, dist_inputs, self._rng)
        return raw, drawing.log_p(dist_inputs, raw)

    def _random(self, policy: str, batch: Batch) -> tuple[NDArray, NDArray]:
        """Return random legal raw actions, and distribution inputs that represent them."""
        mask = batch.observations.get(ACTION_MASK)
        return self._distributions[policy].uniform(mask, len(batch.envs), self._rng)


def _with_previous_action(state: State, raw: NDArray) -> State:
    """Store the drawn action in the state, if the state contains the previous action."""
    return state | {PREVIOUS_ACTION: raw[:, np.newaxis].astype(np.float32) + 1} if PREVIOUS_ACTION in state else state
