"""Plays the league's policies against each other and opponents, step by step, and records transitions."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from ray.rllib.utils.metrics.metrics_logger import MetricsLogger

from league.config.opponents import OpponentConfig
from league.config.training import TrainingSettings
from league.environments.stepping import Batch, BatchedEnvironment, Indices, Starts, Turn
from league.errors import ConfigError
from league.interface import Interface
from league.policies.actions import to_environment
from league.results.records import Scoring
from league.settings import Storage
from league.spaces import ACTION_MASK
from training.modules.policy_module import PREVIOUS_ACTION
from training.sampling.distributions import OrnsteinUhlenbeck, distribution
from training.sampling.opponent_scores import OpponentScores
from training.sampling.opponents import (
    Controllers,
    Matchups,
    Openings,
    OpponentPolicy,
    Opponents,
    RandomMoves,
    without_mixtures,
)
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


OPPONENTS, EPISODES, GAMES, SCORE = "opponents", "episodes", "games", "score"
"""Keys of metrics: opponent → finished episodes, the games that were scored, and the sum of the learner's scores in
them."""

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
        scoring: Scoring = "game",
        *,
        opening_plies: int,
    ) -> None:
        """recorder: receives the play of the league's own policies. initial_states: policy id → initial recurrent
        state, empty if not recurrent. scoring: how games against opponents are scored. opening_plies: maximum number
        of random moves at the start of an episode.

        Raises ConfigError for invalid opponents, and what loading them raises.
        """
        self._stepping, self.recorder = stepping, recorder
        self._policies = tuple(interface.policies[agent] for agent in stepping.agents)
        self._actions = {policy: interface.of_policy(policy).action for policy in interface.policy_ids}
        self._distributions = {policy: distribution(space) for policy, space in self._actions.items()}
        self._initial_states = {policy: state for policy, state in initial_states.items() if state}
        if settings.opponents.any and len(interface.sides) < 2:
            raise ConfigError("training.opponents: the league has one side only: divide the agents into sides")
        self._interface, self._scoring = interface, scoring
        self._fixed = without_mixtures(settings.opponents.fixed, storage)
        self._opponents = Opponents(self._fixed, interface, storage, stepping.num_envs)
        self._arrange(())
        self.noises: dict[str, OrnsteinUhlenbeck] = {}
        """policy id → temporally correlated exploration noise, instead of independent draws."""
        movers = self._controllers.groups([RandomMoves(policy) for policy in self._policies])
        self._openings = Openings(opening_plies, movers, stepping.num_envs)
        self.metrics = PlayMetrics(stepping.agents, self._policies, self._distributions, stepping.num_envs)

    def begin(self, seeds: ResetSeeds, rng: np.random.Generator, opponents: Sequence[OpponentConfig] = ()) -> None:
        """Restart; all further play is determined by `seeds`, `rng` and the opponents from the league."""
        self._seeds, self._rng = seeds, rng
        self._arrange(opponents)
        self._begun = np.zeros(self._stepping.num_envs, np.int64)
        self.recorder.begin(seeds)
        self.restart()

    def exchange(self, opponents: Sequence[OpponentConfig]) -> None:
        """Replace the opponents from the league in new episodes. Open episodes continue with theirs.

        Raises what loading them raises.
        """
        playing = {self._matchups.refs[number] for number in np.unique(self._scores.opponents) if number >= 0}
        self._opponents.exchange([opponent.ref for opponent in opponents], playing)
        self._matchups.exchange([*self._fixed, *opponents])

    def _arrange(self, opponents: Sequence[OpponentConfig]) -> None:
        """Number the controllers anew, so that play does not depend on earlier opponents."""
        self._controllers = Controllers(self._interface)
        self._matchups = Matchups(self._interface, self._stepping.agents, self._controllers)
        self._scores = OpponentScores(self._matchups.sides, self._scoring, self._stepping.num_envs)
        self.exchange(opponents)

    @property
    def is_alone(self) -> bool:
        """Whether nothing has happened in the last step, since no simulator of the game is connected."""
        turn = self._turn
        return not (turn.batches or len(turn.finished) or len(turn.crashed))

    def log(self, metrics: MetricsLogger) -> None:
        """Log everything since the last call."""
        self.metrics.log(metrics)
        results = self._scores.take(len(self._matchups.refs))
        for number, ref in enumerate(self._matchups.refs):
            if results.episodes[number]:
                metrics.log_value((OPPONENTS, ref, EPISODES), int(results.episodes[number]), reduce="sum")
                metrics.log_value((OPPONENTS, ref, GAMES), int(results.games[number]), reduce="sum")
                metrics.log_value((OPPONENTS, ref, SCORE), float(results.scores[number]), reduce="sum")

    def restart(self) -> None:
        """Drop all open episodes, and start new ones in all environments."""
        self.recorder.restart()
        num_envs = self._stepping.num_envs
        self._recurrent_states = {
            policy: RecurrentStates(initial, num_envs, len(self._policies))
            for policy, initial in self._initial_states.items()
        }
        everywhere = np.arange(num_envs)
        self.metrics.forget(everywhere)
        self._scores.forget(everywhere)
        self._forget(everywhere)
        self._read(self._stepping.start(self._next_episodes))

    def record_by(self, recorder: Recorder) -> None:
        """Drop all open episodes, and let another recorder record the following ones."""
        self.recorder = recorder
        recorder.begin(self._seeds)
        self.restart()

    def step(self, forward: Forward | None, explore: bool) -> None:
        """Take a step in each environment. forward: None for random actions. explore: sample instead of taking the
        mode."""
        rows = {self._controllers[group]: batch for group, batch in self._turn.batches.items()}
        forward_inputs = {
            policy: ForwardInput(
                batch.observations,
                self._recurrent_states[policy].get(batch) if policy in self._recurrent_states else None,
            )
            for policy, batch in rows.items()
            if isinstance(policy, str)
        }
        outputs = forward(forward_inputs) if forward and forward_inputs else {}
        actions: dict[int, NDArray] = {}
        for (controller, batch), group in zip(rows.items(), self._turn.batches, strict=True):
            if isinstance(controller, RandomMoves):
                drawn, _ = self._random(controller.policy, batch)
                actions[group] = to_environment(drawn, self._actions[controller.policy])
            elif isinstance(controller, OpponentPolicy):
                actions[group] = self._opponents.act(controller, batch, self._rng)
            else:
                forward_input = forward_inputs[controller]
                actions[group] = self._act(controller, batch, forward_input, outputs.get(controller), explore)
            self.metrics.add_moves(len(batch))
        acting = self._turn.acting(self._stepping.num_envs)
        self._stepping.assign(*self._openings.step(acting))
        self.metrics.add_step(acting)
        self._read(self._stepping.step(actions))

    def _next_episodes(self, envs: Indices) -> Starts:
        pairings = self._matchups.draw(len(envs), self._rng)
        self._scores.begin(envs, pairings.opponents, pairings.sides)
        seeds = self._seeds(envs, self._begun[envs])
        self._begun[envs] += 1
        return Starts(envs, seeds, self._openings.begin(envs, pairings.groups, self._rng))

    def _read(self, turn: Turn) -> None:
        """Process what has ended, then what continues or starts."""
        self._turn = turn
        self.recorder.read(turn)
        self.metrics.add_turn(turn, own_policies=len(self._distributions))
        self._scores.add_turn(turn)
        over = np.concatenate([turn.crashed, turn.finished])
        if len(over):
            self._forget(over)

    def _forget(self, envs: Indices) -> None:
        for states in self._recurrent_states.values():
            states.forget(envs)
        self._opponents.forget(envs)
        for noise in self.noises.values():
            noise.forget(envs)

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
                state = output.state
                if PREVIOUS_ACTION in state:
                    # The drawn action, which may differ from the greedy one that the module has stored.
                    state = state | {PREVIOUS_ACTION: raw[:, np.newaxis].astype(np.float32) + 1}
                self._recurrent_states[policy].update(batch, state)
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
        return self._distributions[policy].uniform(mask, len(batch), self._rng)
