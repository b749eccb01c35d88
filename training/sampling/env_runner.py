"""Samples episodes: an RLlib EnvRunner on the batched stepping of environments."""

import gc
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any
from weakref import WeakKeyDictionary

import gymnasium
import ray
import torch
from numpy.typing import NDArray
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.core import COMPONENT_RL_MODULE
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModule
from ray.rllib.core.rl_module.rl_module import RLModule
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.utils.checkpoints import Checkpointable
from ray.rllib.utils.metrics import NUM_ENV_STEPS_SAMPLED_LIFETIME, WEIGHTS_SEQ_NO

from league.config.league import LeagueConfig
from league.config.opponents import OpponentConfig
from league.config.ppo import PPOConfig
from league.environments.implementation import stepping, stock_stepping
from league.environments.stepping import BatchedEnvironment
from league.errors import ConfigError, LeagueError
from league.interface import Interface
from league.random.seeds import generator
from league.registry.gateways import ForSimulators
from league.results.scoring import scoring
from league.spaces import inputs
from league.spaces.conversion import to_gymnasium
from training.rllib_compat import RaisingEnvRunner, includes_component, subcomponents
from training.sampling.episode_chunks import EpisodeChunks, as_episodes
from training.sampling.recorder import EpisodeRecorder
from training.sampling.reset_seeds import ResetSeeds
from training.sampling.self_play import ForwardInput, ForwardOutput, SelfPlay
from training.sampling.teacher import Teacher

LEAGUE = "league"
INTERFACE = "interface"
STORAGE = "storage"
"""Keys of `env_config`: a LeagueConfig and an Interface, dumped; the Storage of opponents, or None."""

FINISHED_EPISODES = "finished_episodes"
"""In a runner's metrics if there are callbacks: its PlayedEpisodes since the last call."""
SAMPLING_SECONDS, IDLE_SECONDS = "sampling_seconds", "idle_seconds"
"""Wall time of a runner's samples, and between them."""

Spaces = dict[str, tuple[gymnasium.Space, gymnasium.Space]]


class BatchedEnvRunner(RaisingEnvRunner):
    """Samples `num_envs_per_env_runner` environments, stepped together.

    `sample_chunks` returns columns for the league's learners. `sample` returns SingleAgentEpisode chunks of one agent
    and one policy each, with `action_logp` and `action_dist_inputs`; observations are dictionaries ONNX input name →
    array. Episodes continue from one call to the next. Inference runs on one thread, without gradients, in one pass of
    the MultiRLModule per step. Chunks of recurrent policies contain the state before each step, under STATE_IN. Actions
    are raw (league.policies.actions).
    """

    gives_states = False
    """Whether the recorder needs the environments' global states."""
    env: BatchedEnvironment | None
    module: MultiRLModule
    worker_index: int
    _play: SelfPlay | None = None
    _opponents: tuple[OpponentConfig, ...] = ()
    _teacher: Teacher | None = None
    _stage = 0
    _sampling_seconds = _idle_seconds = 0.0
    _idle_since: float | None = None
    """The end of the last sample; None if what follows is no idle time: a checkpoint is saved, or nothing sampled."""

    def __init__(self, config: AlgorithmConfig, **kwargs: Any) -> None:
        """Raises ConfigError if the environment, its opponents, a requested GPU or the teacher are not available."""
        super().__init__(config=config, **kwargs)
        self.league = LeagueConfig.model_validate(self.config.env_config[LEAGUE])
        self.interface = Interface.model_validate(self.config.env_config[INTERFACE])
        self.worker_index = self.worker_index or 0
        # With remote runners, the local one only holds weights and counters.
        self._samples = self.worker_index > 0 or not self.config.num_env_runners
        self.make_module()
        if self._samples:
            try:
                self.make_env()
                settings = self.league.training
                if isinstance(settings, PPOConfig) and settings.teacher is not None:
                    storage = self.config.env_config.get(STORAGE)
                    self._teacher = Teacher(settings.teacher, self.interface, storage, settings.seed)
            except BaseException:
                self.stop()
                raise

    def make_env(self) -> None:
        """Create the environments, after closing previous ones."""
        self.stop()
        storage = self.config.env_config.get(STORAGE)
        with self._errors_with_league():
            num_envs, crashes = self.config.num_envs_per_env_runner, self.league.training.crashes
            critic = self.league.training.critic if isinstance(self.league.training, PPOConfig) else "own"
            stages, environment = self.league.training.curriculum, self.league.stage_environment(self._stage)
            states = self.gives_states or critic == "state"
            if stages and stages[self._stage].is_random:  # a vectorised environment has the same arguments throughout
                of_seed = partial(self.league.stage_environment, self._stage)
                self.env = stock_stepping(environment, num_envs, crashes=crashes, states=states, of_seed=of_seed)
            else:
                fast_seeds = self.league.training.seeds == "fast"
                self.env = stepping(
                    environment,
                    num_envs,
                    crashes=crashes,
                    states=states,
                    fast_seeds=fast_seeds,
                    simulators=None if storage is None else ForSimulators(storage, self.league.league, "training"),
                )
            initial = initial_states(self.module)
            self._chunks = EpisodeRecorder(self.interface, self.env.agents, num_envs, critic)
            self._play = SelfPlay(
                self.env,
                self.interface,
                self.league.training,
                self._chunks,
                initial,
                storage,
                scoring(self.league, self.interface),
                opening_plies=self.league.training_openings,
            )
        self._has_begun = False
        # Some environments create reference cycles at every reset. Without freezing, each collection would traverse
        # everything that Ray and torch have loaded.
        gc.freeze()

    def make_module(self) -> None:
        """Build the policies' modules from the configuration."""
        spec = self.config.get_multi_rl_module_spec(spaces=self.get_spaces(), inference_only=True)
        self.module = spec.build()
        # Module → the update that its weights are from; modules with initial weights have no entry.
        self._weights_from: WeakKeyDictionary[RLModule, int] = WeakKeyDictionary()
        on_gpu = self._samples and self.league.training.runner_gpus > 0
        if on_gpu and not torch.cuda.is_available():
            raise ConfigError(
                f"league {self.league.league}: training.runner_gpus: torch finds no GPU on a runner's machine"
            )
        self._device = torch.device("cuda" if on_gpu else "cpu")
        for module in self.module.values():
            # Otherwise each pass would switch the mode back and forth.
            module.to(self._device).eval()

    def get_spaces(self) -> Spaces:
        """Return policy id → (observations by ONNX input name, actions)."""
        return {policy: module_spaces(self.interface, policy) for policy in self.interface.policy_ids}

    def assert_healthy(self) -> None:
        """Raise AssertionError if this runner cannot sample."""
        assert self.env is not None
        assert self.module is not None

    def sample(self, **kwargs: Any) -> list[SingleAgentEpisode]:
        """Return what `sample_chunks` returns as RLlib's episodes, which takes 15 µs per chunk."""
        assert self.env is not None, "a runner that only holds weights cannot sample"
        return [episode for chunks in self.sample_chunks(**kwargs) for episode in as_episodes(chunks, self.env.agents)]

    def sample_chunks(
        self,
        *,
        num_timesteps: int | None = None,
        num_episodes: int | None = None,
        explore: bool | None = None,
        random_actions: bool = False,
        force_reset: bool = False,
        taught: Collection[str] = (),
        **_: Any,
    ) -> list[EpisodeChunks]:
        """Play, and return all completed transitions, at least one: the chunks of each policy.

        Returns nothing if no simulator of the game is connected. What was played is in the next sample.

        Args:
            num_timesteps: Minimum number of actions; by default the configured fragment length in each environment.
            num_episodes: Minimum number of complete episodes, instead of `num_timesteps`.
            explore: Sample actions instead of taking the most probable ones; by default as configured.
            random_actions: Take uniform legal actions instead of the module's.
            force_reset: Drop the open episodes first.
            taught: The policies on whose steps the teacher acts, too.
        """
        assert num_timesteps is None or num_episodes is None, "num_timesteps and num_episodes are mutually exclusive"
        assert self._play is not None, "a runner that only holds weights cannot sample"
        if num_timesteps is None and num_episodes is None:
            fragment = self.config.get_rollout_fragment_length(self.worker_index)
            num_timesteps = fragment * self.config.num_envs_per_env_runner
        explore = self.config.explore if explore is None else explore
        compute = self.module.forward_exploration if explore else self.module.forward_inference
        forward = None if random_actions else partial(self._forward, compute)
        play = self._play
        with self._errors_with_league(), one_thread():
            if not self._has_begun:
                self.reset_episodes(self.num_env_steps_sampled_lifetime)
            elif force_reset:
                play.restart()
            steps = play.metrics.steps + num_timesteps if num_timesteps is not None else 0
            episodes = play.metrics.episodes + (num_episodes or 0)
            chunks: list[EpisodeChunks] = []
            while play.metrics.steps < steps or play.metrics.episodes < episodes or not (chunks := self._chunks.cut()):
                play.step(forward, explore)
                if play.is_alone:
                    return []
        if not taught:
            return chunks
        assert self._teacher is not None, "the league has no teacher"
        return [replace(part, taught=self._teacher.actions(part)) if part.policy in taught else part for part in chunks]

    def reset_episodes(self, steps: int) -> None:
        """Drop all open episodes. Further play depends on the weights, the run's seed, and `steps` only.

        steps: actions of the whole run so far. Two runners reset with the same number play identically.
        """
        assert self._play is not None, "a runner that only holds weights cannot play"
        seed = self.config.seed or 0
        seeds = ResetSeeds.of_run(
            seed,
            runner=max(self.worker_index - 1, 0),
            runners=max(self.config.num_env_runners, 1),
            num_envs=self.config.num_envs_per_env_runner,
            steps=steps,
        )
        with self._errors_with_league():
            self._play.begin(seeds, generator(seed, "play", seeds.runner, steps), self._opponents)
        self._has_begun = True
        self._idle_since = None

    def enter_stage(self, stage: int) -> None:
        """Play in the environment of a stage of the curriculum, from 0. Episodes must be reset afterwards."""
        if stage == self._stage:
            return
        self._stage = stage
        if self._samples:
            self.make_env()

    def exchange_opponents(self, opponents: Sequence[OpponentConfig]) -> None:
        """Replace the opponents from the league in new episodes. Raises what loading them raises."""
        if opponents == self._opponents:
            return
        self._opponents = tuple(opponents)
        if self._play is not None and self._has_begun:
            with self._errors_with_league():
                self._play.exchange(self._opponents)

    def get_metrics(self) -> dict[str, Any]:
        """Return statistics since the last call, per policy and in total."""
        if self._play is not None:
            self._play.log(self.metrics)
        self.metrics.log_value(SAMPLING_SECONDS, self._sampling_seconds, reduce="sum")
        self.metrics.log_value(IDLE_SECONDS, self._idle_seconds, reduce="sum")
        self._sampling_seconds = self._idle_seconds = 0.0
        self.metrics.log_value(WEIGHTS_SEQ_NO, self._weights_seq_no, window=1)
        metrics = self.metrics.reduce()
        if self.league.training.callbacks and self._play is not None and self._play.metrics.logged is not None:
            metrics[FINISHED_EPISODES] = self._play.metrics.logged
        return metrics

    def get_state(
        self,
        components: str | Collection[str] | None = None,
        *,
        not_components: str | Collection[str] | None = None,
        **kwargs: Any,
    ) -> dict[str, Any]:
        """Return the modules' weights with their sequence number, and the number of steps of the whole run."""
        state: dict[str, Any] = {NUM_ENV_STEPS_SAMPLED_LIFETIME: self.num_env_steps_sampled_lifetime}
        if includes_component(self, COMPONENT_RL_MODULE, components, not_components):
            state[COMPONENT_RL_MODULE] = self.module.get_state(
                components=subcomponents(self, COMPONENT_RL_MODULE, components),
                not_components=subcomponents(self, COMPONENT_RL_MODULE, not_components),
                **kwargs,
            )
            state[WEIGHTS_SEQ_NO] = self._weights_seq_no
        return state

    def set_state(self, state: dict[str, Any]) -> None:
        """Load the weights of each module that are newer than its own (0 or no number: always), and the number of
        steps.

        RLlib's runners keep one sequence number for all modules, and skip a module that was added later (ray#61960).
        """
        if COMPONENT_RL_MODULE in state:
            update = state.get(WEIGHTS_SEQ_NO, 0)
            weights = state[COMPONENT_RL_MODULE]
            weights = ray.get(weights) if isinstance(weights, ray.ObjectRef) else weights
            modules = {policy: module for policy, module in self.module.items() if policy in weights}
            outdated = {
                policy: module
                for policy, module in modules.items()
                if update == 0 or self._weights_from.get(module, -1) < update
            }
            self.module.set_state({policy: weights[policy] for policy in outdated})
            self._weights_from.update(
                {module: max(update, self._weights_from.get(module, 0)) for module in outdated.values()}
            )
        if NUM_ENV_STEPS_SAMPLED_LIFETIME in state:
            self.num_env_steps_sampled_lifetime = state[NUM_ENV_STEPS_SAMPLED_LIFETIME]

    def get_ctor_args_and_kwargs(self) -> tuple[tuple[Any, ...], dict[str, Any]]:
        return (), {"config": self.config, "worker_index": self.worker_index}

    def get_checkpointable_components(self) -> list[tuple[str, Checkpointable]]:
        return [(COMPONENT_RL_MODULE, self.module)]

    def stop(self) -> None:
        """Close the environments."""
        if self.env is not None:
            self.env.close()
            self.env = self._play = None
            gc.unfreeze()

    @property
    def _weights_seq_no(self) -> int:
        return max(self._weights_from.values(), default=0)

    @contextmanager
    def timed_sample(self) -> Iterator[None]:
        """Measure how long the block takes, which samples, and how long the runner was idle before it."""
        began = time.perf_counter()
        if self._idle_since is not None:
            self._idle_seconds += began - self._idle_since
        try:
            yield
        finally:
            self._idle_since = time.perf_counter()
            self._sampling_seconds += self._idle_since - began

    @contextmanager
    def _errors_with_league(self) -> Iterator[None]:
        """Prefix the messages of errors with the league's name."""
        try:
            yield
        except LeagueError as error:
            name = f"league {self.league.league}: "
            if str(error).startswith(name):
                raise
            raise type(error)(name + str(error)) from error

    def _forward(
        self, compute: Callable[[dict[str, Any]], dict[str, Any]], forward_inputs: Mapping[str, ForwardInput]
    ) -> dict[str, ForwardOutput]:
        """Run one forward pass for all policies that must act. compute: of the module."""
        batch: dict[str, Any] = {}
        for policy, forward_input in forward_inputs.items():
            batch[policy] = {Columns.OBS: self._tensors(forward_input.observations)}
            if forward_input.state is not None:
                batch[policy][Columns.STATE_IN] = self._tensors(forward_input.state)
        with torch.inference_mode():
            outputs = compute(batch)
        return {
            policy: ForwardOutput(
                output[Columns.ACTION_DIST_INPUTS].cpu().numpy(),
                _arrays(output[Columns.STATE_OUT]) if Columns.STATE_OUT in output else None,
            )
            for policy, output in outputs.items()
        }

    def _tensors(self, arrays: Mapping[str, NDArray]) -> dict[str, torch.Tensor]:
        return {name: torch.from_numpy(array).to(self._device) for name, array in arrays.items()}


@contextmanager
def one_thread() -> Iterator[None]:
    """Use one torch thread: for a few rows, several threads spend more time waiting than working."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def initial_states(module: MultiRLModule) -> dict[str, dict[str, NDArray]]:
    """Return policy id → initial recurrent state; empty if not recurrent."""
    return {policy: _arrays(policy_module.get_initial_state()) for policy, policy_module in module.items()}


def _arrays(state: Mapping[str, Any]) -> dict[str, NDArray]:
    return {key: value.cpu().numpy() if isinstance(value, torch.Tensor) else value for key, value in state.items()}


def module_spaces(interface: Interface, policy: str) -> tuple[gymnasium.spaces.Dict, gymnasium.Space]:
    """Return the spaces of a policy's module: observations as a Dict of ONNX input names, and actions."""
    spaces = interface.of_policy(policy)
    parts = {name: to_gymnasium(leaf) for name, leaf in inputs(spaces.observation).items()}
    return gymnasium.spaces.Dict(parts), to_gymnasium(spaces.action)
