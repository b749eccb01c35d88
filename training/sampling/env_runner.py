"""RLlib's EnvRunner on the kernel's lockstep stepping."""

from collections.abc import Callable, Collection
from typing import Any

import gymnasium
import ray
import torch
from numpy.typing import NDArray
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.core import COMPONENT_RL_MODULE
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModule
from ray.rllib.env.env_runner import EnvRunner
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.utils.checkpoints import Checkpointable
from ray.rllib.utils.metrics import NUM_ENV_STEPS_SAMPLED_LIFETIME, WEIGHTS_SEQ_NO

from league.config import LeagueConfig
from league.environments.lockstep import stepping
from league.environments.stepping import BatchedEnvironment
from league.interface import Interface
from league.seeds import generator
from league.spaces import inputs, to_gymnasium
from training.sampling.reset_seeds import ResetSeeds
from training.sampling.self_play import SelfPlay

LEAGUE = "league"
INTERFACE = "interface"
STORAGE = "storage"
"""Keys of `env_config`: a LeagueConfig and an Interface, dumped; the Storage that opponents are loaded from, or None."""

Spaces = dict[str, tuple[gymnasium.Space, gymnasium.Space]]


class LockstepEnvRunner(EnvRunner, Checkpointable):
    """Samples `num_envs_per_env_runner` copies of the league's environment in lockstep.

    `sample` returns SingleAgentEpisode chunks of one agent and one policy each, with `action_logp` and
    `action_dist_inputs`, their observations as dictionaries ONNX input name → array. Episodes go on from one call to
    the next. Acting runs on one thread, without gradients, on the module's own exploration or inference pass.
    """

    env: BatchedEnvironment | None
    module: MultiRLModule
    worker_index: int
    _play: SelfPlay | None = None

    def __init__(self, config: AlgorithmConfig, **kwargs: Any) -> None:
        super().__init__(config=config, **kwargs)
        self.league = LeagueConfig.model_validate(self.config.env_config[LEAGUE])
        self.interface = Interface.model_validate(self.config.env_config[INTERFACE])
        self.worker_index = self.worker_index or 0
        self._weights_seq_no = 0
        # A local runner beside remote ones only keeps the weights and counters.
        if self.worker_index > 0 or not self.config.num_env_runners:
            torch.set_num_threads(1)
            self.make_env()
        self.make_module()

    def make_env(self) -> None:
        """Build the copies, closing those of before."""
        self.stop()
        self.env = stepping(self.league.environment, self.config.num_envs_per_env_runner)
        self._play = None

    def make_module(self) -> None:
        """Build the policies' modules as the configuration says."""
        spec = self.config.get_multi_rl_module_spec(spaces=self.get_spaces(), inference_only=True)
        self.module = spec.build()

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
        if num_timesteps is None and num_episodes is None:
            fragment = self.config.get_rollout_fragment_length(self.worker_index)
            num_timesteps = fragment * self.config.num_envs_per_env_runner
        play = self._begin() if self._play is None else self._play
        if force_reset:
            play.restart()
        explore = self.config.explore if explore is None else explore
        logits = play.uniform if random_actions else self._explore if explore else self._infer
        steps = play.metrics.steps + num_timesteps if num_timesteps is not None else 0
        episodes = play.metrics.episodes + (num_episodes or 0)
        while play.metrics.steps < steps or play.metrics.episodes < episodes:
            play.step(logits, explore or random_actions)
        while not play.has_transitions:
            play.step(logits, explore or random_actions)
        return play.cut()

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
        """Take over weights that are newer than this runner's (0 or none: always), and the steps of the run."""
        if COMPONENT_RL_MODULE in state:
            weights_seq_no = state.get(WEIGHTS_SEQ_NO, 0)
            if weights_seq_no == 0 or weights_seq_no > self._weights_seq_no:
                weights = state[COMPONENT_RL_MODULE]
                self.module.set_state(ray.get(weights) if isinstance(weights, ray.ObjectRef) else weights)
            self._weights_seq_no = max(weights_seq_no, self._weights_seq_no)
        if NUM_ENV_STEPS_SAMPLED_LIFETIME in state:
            self.num_env_steps_sampled_lifetime = state[NUM_ENV_STEPS_SAMPLED_LIFETIME]

    def get_ctor_args_and_kwargs(self) -> tuple[tuple[Any, ...], dict[str, Any]]:
        return (), {"config": self.config, "worker_index": self.worker_index}

    def get_checkpointable_components(self) -> list[tuple[str, Checkpointable]]:
        return [(COMPONENT_RL_MODULE, self.module)]

    def stop(self) -> None:
        """Close the copies."""
        if self.env is not None:
            self.env.close()
            self.env = None

    def _begin(self) -> SelfPlay:
        """Only at the first sample, as the steps of the run are not known before."""
        assert self.env is not None, "a runner that only keeps weights cannot sample"
        seed, steps = self.config.seed or 0, self.num_env_steps_sampled_lifetime
        seeds = ResetSeeds.of_run(
            seed,
            runner=max(self.worker_index - 1, 0),
            runners=max(self.config.num_env_runners, 1),
            copies=self.env.copies,
            steps=steps,
        )
        rng = generator(seed, "play", self.worker_index, steps)
        self._play = SelfPlay(self.env, self.interface, seeds, self.league.training.opening_plies, rng)
        return self._play

    def _explore(self, policy: str, observations: dict[str, NDArray]) -> NDArray:
        return _logits(self.module[policy].forward_exploration, observations)

    def _infer(self, policy: str, observations: dict[str, NDArray]) -> NDArray:
        return _logits(self.module[policy].forward_inference, observations)


def _logits(forward: Callable[[dict[str, Any]], dict[str, Any]], observations: dict[str, NDArray]) -> NDArray:
    tensors = {name: torch.from_numpy(array) for name, array in observations.items()}
    return forward({Columns.OBS: tensors})[Columns.ACTION_DIST_INPUTS].numpy()


def module_spaces(interface: Interface, policy: str) -> tuple[gymnasium.spaces.Dict, gymnasium.Space]:
    """The spaces of a policy's module: ONNX input name → part of the observation, and the action."""
    spaces = interface.of_policy(policy)
    parts = {name: to_gymnasium(leaf) for name, leaf in inputs(spaces.observation).items()}
    return gymnasium.spaces.Dict(parts), to_gymnasium(spaces.action)
