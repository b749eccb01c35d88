"""RLlib's EnvRunner on the kernel's lockstep stepping."""

import gc
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
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
from ray.rllib.env.env_runner import EnvRunner
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.utils.checkpoints import Checkpointable
from ray.rllib.utils.metrics import NUM_ENV_STEPS_SAMPLED_LIFETIME, WEIGHTS_SEQ_NO

from league.config import LeagueConfig
from league.environments.lockstep import stepping
from league.environments.stepping import BatchedEnvironment
from league.errors import ConfigError, LeagueError
from league.interface import Interface
from league.seeds import generator
from league.spaces import inputs, to_gymnasium
from training.sampling.recorder import Chunks
from training.sampling.reset_seeds import ResetSeeds
from training.sampling.self_play import Answer, Ask, SelfPlay

LEAGUE = "league"
INTERFACE = "interface"
STORAGE = "storage"
"""Keys of `env_config`: a LeagueConfig and an Interface, dumped; the Storage of opponents, or None."""

Spaces = dict[str, tuple[gymnasium.Space, gymnasium.Space]]


class LockstepEnvRunner(EnvRunner, Checkpointable):
    """Samples `num_envs_per_env_runner` copies of the league's environment in lockstep.

    `sample` returns SingleAgentEpisode chunks of one agent and one policy each, with `action_logp` and
    `action_dist_inputs`, their observations as dictionaries ONNX input name → array. Episodes go on from one call to
    the next. Acting runs on one thread, without gradients, in one pass of the whole MultiRLModule per step. A policy
    with a memory also leaves the state before each step, under STATE_IN. Actions are raw (league.policies.actions).
    """

    gives_states = False
    """Whether the environments' global states are wanted."""
    env: BatchedEnvironment | None
    module: MultiRLModule
    worker_index: int
    _play: SelfPlay | None = None

    def __init__(self, config: AlgorithmConfig, **kwargs: Any) -> None:
        """Raises ConfigError where the environment, its opponents or a GPU that is asked for are not to be had."""
        super().__init__(config=config, **kwargs)
        self.league = LeagueConfig.model_validate(self.config.env_config[LEAGUE])
        self.interface = Interface.model_validate(self.config.env_config[INTERFACE])
        self.worker_index = self.worker_index or 0
        # A local runner beside remote ones only keeps the weights and counters.
        self._samples = self.worker_index > 0 or not self.config.num_env_runners
        self.make_module()
        if self._samples:
            self.make_env()
            # Some environments leave cycles of garbage at every reset; to find them, Python would go through all that
            # Ray and torch have loaded, time and again.
            gc.freeze()

    def make_env(self) -> None:
        """Build the copies, closing those of before."""
        self.stop()
        with self._named():
            copies, crashes = self.config.num_envs_per_env_runner, self.league.training.crashes
            self.env = stepping(self.league.environment, copies, crashes=crashes, states=self.gives_states)
            initial = {policy: _arrays(module.get_initial_state()) for policy, module in self.module.items()}
            storage = self.config.env_config.get(STORAGE)
            self._chunks = Chunks(self.interface, self.env.agents, copies)
            self._play = SelfPlay(self.env, self.interface, self.league.training, self._chunks, initial, storage)
        self._has_begun = False

    def make_module(self) -> None:
        """Build the policies' modules as the configuration says."""
        spec = self.config.get_multi_rl_module_spec(spaces=self.get_spaces(), inference_only=True)
        self.module = spec.build()
        # Which update the weights of each module come from; a module without an entry has weights of its own making.
        self._weights_from: WeakKeyDictionary[RLModule, int] = WeakKeyDictionary()
        on_gpu = self._samples and self.league.training.runner_gpus > 0
        if on_gpu and not torch.cuda.is_available():
            raise ConfigError(f"league {self.league.league}: training.runner_gpus: torch sees no GPU at a runner")
        self._device = torch.device("cuda" if on_gpu else "cpu")
        for module in self.module.values():
            # Else every pass would switch it, and back.
            module.to(self._device).eval()

    def get_spaces(self) -> Spaces:
        """Policy id → its observations, by ONNX input name, and its actions."""
        return {policy: module_spaces(self.interface, policy) for policy in self.interface.policy_ids}

    def assert_healthy(self) -> None:
        """Raise AssertionError unless this runner can sample."""
        assert self.env is not None
        assert self.module is not None

    def sample(
        self,
        *,
        num_timesteps: int | None = None,
        num_episodes: int | None = None,
        explore: bool | None = None,
        random_actions: bool = False,
        force_reset: bool = False,
        **_: Any,
    ) -> list[SingleAgentEpisode]:
        """Play at least `num_timesteps` actions or `num_episodes` whole episodes, by default the configuration's
        fragment in each copy, and return all transitions that were closed. Goes on until there is one.

        explore: sample actions instead of taking the most probable; by default as configured.
        random_actions: uniform legal actions instead of the module's.
        force_reset: forget the episodes that are under way.
        """
        assert num_timesteps is None or num_episodes is None, "num_timesteps and num_episodes exclude one another"
        assert self._play is not None, "a runner that only keeps weights cannot sample"
        if num_timesteps is None and num_episodes is None:
            fragment = self.config.get_rollout_fragment_length(self.worker_index)
            num_timesteps = fragment * self.config.num_envs_per_env_runner
        explore = self.config.explore if explore is None else explore
        think = None if random_actions else self._explore if explore else self._infer
        play = self._play
        with self._named(), one_thread():
            if not self._has_begun:
                self.begin_anew(self.num_env_steps_sampled_lifetime)
            elif force_reset:
                play.restart()
            steps = play.metrics.steps + num_timesteps if num_timesteps is not None else 0
            episodes = play.metrics.episodes + (num_episodes or 0)
            while play.metrics.steps < steps or play.metrics.episodes < episodes:
                play.step(think, explore)
            while not (chunks := self._chunks.cut()):
                play.step(think, explore)
        return chunks

    def begin_anew(self, steps: int) -> None:
        """Leave all episodes under way. What comes next is decided by the weights, the run's seed, and `steps`, those
        of the whole run so far: two runners that begin anew with the same play the same."""
        assert self._play is not None, "a runner that only keeps weights cannot play"
        seed = self.config.seed or 0
        seeds = ResetSeeds.of_run(
            seed,
            runner=max(self.worker_index - 1, 0),
            runners=max(self.config.num_env_runners, 1),
            copies=self.config.num_envs_per_env_runner,
            steps=steps,
        )
        with self._named():
            self._play.begin(seeds, generator(seed, "play", seeds.runner, steps))
        self._has_begun = True

    def get_metrics(self) -> dict[str, Any]:
        """Statistics of the play since the last call, per policy and in all."""
        if self._play is not None:
            self._play.metrics.log(self.metrics)
        self.metrics.log_value(WEIGHTS_SEQ_NO, self._weights_seq_no, window=1)
        return self.metrics.reduce()

    def get_state(
        self,
        components: str | Collection[str] | None = None,
        *,
        not_components: str | Collection[str] | None = None,
        **kwargs: Any,
    ) -> dict[str, Any]:
        """The modules' weights with their sequence number, and the steps of the whole run."""
        state: dict[str, Any] = {NUM_ENV_STEPS_SAMPLED_LIFETIME: self.num_env_steps_sampled_lifetime}
        if self._check_component(COMPONENT_RL_MODULE, components, not_components):
            state[COMPONENT_RL_MODULE] = self.module.get_state(
                components=self._get_subcomponents(COMPONENT_RL_MODULE, components),
                not_components=self._get_subcomponents(COMPONENT_RL_MODULE, not_components),
                **kwargs,
            )
            state[WEIGHTS_SEQ_NO] = self._weights_seq_no
        return state

    def set_state(self, state: dict[str, Any]) -> None:
        """Take over the weights of each module whose own are of an earlier update (0 or none: always), and the steps of
        the run. RLlib's runners have one number for all modules, and leave out one that was added after it."""
        if COMPONENT_RL_MODULE in state:
            update = state.get(WEIGHTS_SEQ_NO, 0)
            weights = state[COMPONENT_RL_MODULE]
            weights = ray.get(weights) if isinstance(weights, ray.ObjectRef) else weights
            modules = {policy: module for policy, module in self.module.items() if policy in weights}
            behind = {
                policy: module
                for policy, module in modules.items()
                if update == 0 or self._weights_from.get(module, -1) < update
            }
            self.module.set_state({policy: weights[policy] for policy in behind})
            self._weights_from.update(
                {module: max(update, self._weights_from.get(module, 0)) for module in behind.values()}
            )
        if NUM_ENV_STEPS_SAMPLED_LIFETIME in state:
            self.num_env_steps_sampled_lifetime = state[NUM_ENV_STEPS_SAMPLED_LIFETIME]

    def get_ctor_args_and_kwargs(self) -> tuple[tuple[Any, ...], dict[str, Any]]:
        return (), {"config": self.config, "worker_index": self.worker_index}

    def get_checkpointable_components(self) -> list[tuple[str, Checkpointable]]:
        return [(COMPONENT_RL_MODULE, self.module)]

    def apply(self, func: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """Call `func` with this runner. RLlib's own ends the process on an exception, and what was wrong is lost."""
        return func(self, *args, **kwargs)

    def stop(self) -> None:
        """Close the copies."""
        if self.env is not None:
            self.env.close()
            self.env = self._play = None
            gc.unfreeze()

    @property
    def _weights_seq_no(self) -> int:
        return max(self._weights_from.values(), default=0)

    @contextmanager
    def _named(self) -> Iterator[None]:
        """What is the matter, and in which league."""
        try:
            yield
        except LeagueError as error:
            name = f"league {self.league.league}: "
            if str(error).startswith(name):
                raise
            raise type(error)(name + str(error)) from error

    def _explore(self, asks: Mapping[str, Ask]) -> dict[str, Answer]:
        return self._think(self.module.forward_exploration, asks)

    def _infer(self, asks: Mapping[str, Ask]) -> dict[str, Answer]:
        return self._think(self.module.forward_inference, asks)

    def _think(self, forward: Callable[[dict[str, Any]], dict[str, Any]], asks: Mapping[str, Ask]) -> dict[str, Answer]:
        """One pass for all policies that must act."""
        batch: dict[str, Any] = {}
        for policy, ask in asks.items():
            batch[policy] = {Columns.OBS: self._tensors(ask.observations)}
            if ask.state is not None:
                batch[policy][Columns.STATE_IN] = self._tensors(ask.state)
        with torch.inference_mode():
            answers = forward(batch)
        return {
            policy: Answer(
                answer[Columns.ACTION_DIST_INPUTS].cpu().numpy(),
                _arrays(answer[Columns.STATE_OUT]) if Columns.STATE_OUT in answer else None,
            )
            for policy, answer in answers.items()
        }

    def _tensors(self, arrays: Mapping[str, NDArray]) -> dict[str, torch.Tensor]:
        return {name: torch.from_numpy(array).to(self._device) for name, array in arrays.items()}


@contextmanager
def one_thread() -> Iterator[None]:
    """Rows of one step are too few to be shared out, and each runner has one core."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _arrays(state: Mapping[str, Any]) -> dict[str, NDArray]:
    return {key: value.cpu().numpy() if isinstance(value, torch.Tensor) else value for key, value in state.items()}


def module_spaces(interface: Interface, policy: str) -> tuple[gymnasium.spaces.Dict, gymnasium.Space]:
    """The spaces of a policy's module: ONNX input name → part of the observation, and the action."""
    spaces = interface.of_policy(policy)
    parts = {name: to_gymnasium(leaf) for name, leaf in inputs(spaces.observation).items()}
    return gymnasium.spaces.Dict(parts), to_gymnasium(spaces.action)
