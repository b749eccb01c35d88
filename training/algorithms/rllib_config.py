"""The RLlib configuration that all algorithms share, and the choice of an algorithm by name."""

from collections.abc import Sequence
from importlib import import_module
from typing import Any

from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.core.learner.learner import Learner
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec

from league.config.algorithms import AnyTraining
from league.config.league import LeagueConfig
from league.config.ppo import PPOConfig
from league.config.training import PhaseConfig, TrainingSettings
from league.environments.implementation import STOCK_ENVS, VECTOR_ENVS, check_fast_seeds, implementation
from league.errors import ConfigError
from league.interface import Interface
from league.policies.actions import dist_inputs_size
from league.results.scoring import scoring
from league.settings import Storage
from training.modules.policy_module import PolicyModule
from training.sampling.env_runner import INTERFACE, LEAGUE, STORAGE, BatchedEnvRunner, module_spaces
from training.sampling.opponent_scores import is_scored


def learning_policies(settings: TrainingSettings, policies: tuple[str, ...], iteration: int) -> tuple[str, ...]:
    """Return the policies to update after `iteration` earlier updates; phases repeat cyclically."""
    planned = settings.policies_to_train
    if planned is None:
        return policies
    phases = [phase for phase in planned if isinstance(phase, PhaseConfig)]
    if not phases:
        return tuple(policy for policy in policies if policy in planned)
    place = iteration % sum(phase.iterations for phase in phases)
    for phase in phases:
        if place < phase.iterations:
            return tuple(policy for policy in policies if policy in phase.policies)
        place -= phase.iterations
    raise AssertionError("unreachable: the position lies in one of the phases")


def check_policies_to_train(settings: TrainingSettings, policies: tuple[str, ...]) -> None:
    """Raise ConfigError if `policies_to_train` names an unknown policy, or excludes one that shares its encoder."""
    planned = settings.policies_to_train
    if planned is None:
        return
    shared_encoder = isinstance(settings, PPOConfig) and settings.shared_encoder
    for part in planned:
        named: Sequence[str] = part.policies if isinstance(part, PhaseConfig) else (part,)
        for policy in named:
            if policy not in policies:
                policy_names = ", ".join(policies)
                raise ConfigError(
                    f"training.policies_to_train: unknown policy {policy!r}; the league has {policy_names}"
                )
        if shared_encoder and isinstance(part, PhaseConfig) and set(named) != set(policies):
            raise _shared_encoder_error()
    if shared_encoder and not isinstance(planned[0], PhaseConfig) and set(planned) != set(policies):
        raise _shared_encoder_error()


def check_opponents(league: LeagueConfig, interface: Interface) -> None:
    """Raise ConfigError if opponents are drawn by scores that training games do not have."""
    drawn = league.training.opponents.league
    if drawn is None or drawn.sampling != "pfsp" or is_scored(scoring(league, interface), len(interface.sides)):
        return
    raise ConfigError(
        f"training.opponents.league.sampling: pfsp needs scores, but games between {len(interface.sides)} sides are"
        " compared by side: use uniform or latest"
    )


def _shared_encoder_error() -> ConfigError:
    return ConfigError(
        "training.policies_to_train: with shared_encoder, all policies must learn together: training the encoder would"
        " change the others, too"
    )


def configure(
    config: AlgorithmConfig,
    league: LeagueConfig,
    interface: Interface,
    storage: Storage | None,
    *,
    modules: MultiRLModuleSpec,
    runner: type[BatchedEnvRunner],
    learner: type[Learner],
) -> None:
    """Set everything in `config` except the algorithm's own hyperparameters.

    Raises ConfigError if `policies_to_train`, `opponents` or `seeds` do not fit the league.
    """
    settings = league.training
    check_policies_to_train(settings, interface.policy_ids)
    check_opponents(league, interface)
    if settings.seeds == "fast":
        check_fast_seeds(league.environment)
    config.environment(
        env_config={
            LEAGUE: league.model_dump(mode="json", by_alias=True),
            INTERFACE: interface.model_dump(mode="json"),
            STORAGE: storage,
        }
    )
    config.multi_agent(
        policies=interface.policy_ids,  # the order determines seeded weights and minibatches
        policy_mapping_fn=lambda agent, *_, **__: interface.policies[agent],
    )
    config.rl_module(rl_module_spec=modules)
    config.env_runners(
        env_runner_cls=runner,
        num_env_runners=settings.runners,
        num_envs_per_env_runner=num_envs(league, len(interface.agents)),
        num_gpus_per_env_runner=settings.runner_gpus,
        # The runners have no connector state that could be merged.
        merge_env_runner_states=False,
    )
    # The learner runs in the algorithm's process.
    config.learners(
        learner_class=learner,
        num_learners=0,
        num_gpus_per_learner=settings.gpus,
        add_default_connectors_to_learner_pipeline=False,
    )
    # Report faults of an environment instead of retrying forever; a failed run can be resumed.
    config.fault_tolerance(restart_failed_env_runners=False, ignore_env_runner_failures=False)
    config.debugging(seed=settings.seed, log_level="ERROR")
    config.reporting(min_time_s_per_iteration=0)


STEPS_PER_BATCH = 16
"""Minimum number of steps of an agent in each environment per batch: advantages of shorter chunks are mostly guesses of
the value function."""


def num_envs(league: LeagueConfig, agents: int) -> int:
    """Return the number of parallel environments of a runner."""
    settings = league.training
    if settings.num_envs != "auto":
        return settings.num_envs
    if not isinstance(settings, PPOConfig) or implementation(league.environment).vector is None:
        return STOCK_ENVS
    fitting = settings.train_batch_size // (max(settings.runners, 1) * agents * STEPS_PER_BATCH)
    return min(max(fitting, STOCK_ENVS), VECTOR_ENVS)


def encoder_settings(settings: TrainingSettings) -> dict[str, Any]:
    """Return the part of `model_config` that describes a module's encoder."""
    return {
        "hidden": settings.hidden,
        "convolutions": [(layer.filters, layer.kernel, layer.stride) for layer in settings.convolutions],
        "channels": settings.channels,
        "normalize": settings.normalize_observations,
    }


def rl_module_specs(
    interface: Interface, module: type[PolicyModule], model_config: dict[str, Any]
) -> dict[str, RLModuleSpec]:
    """Return policy id → module specification. Raises ConfigError for unsupported action spaces."""
    specs = {}
    for policy in interface.policy_ids:
        try:
            dist_inputs_size(interface.of_policy(policy).action)
        except ConfigError as error:
            raise ConfigError(f"policies.{policy}: {error}") from error
        observation, action = module_spaces(interface, policy)
        specs[policy] = RLModuleSpec(
            module_class=module, observation_space=observation, action_space=action, model_config=model_config
        )
    return specs


def algorithm_config(league: LeagueConfig, interface: Interface, storage: Storage | None = None) -> AlgorithmConfig:
    """Return RLlib's configuration of a league's training.

    Args:
        league: The league and its training settings.
        interface: The spaces and policies of the league's environment.
        storage: Where to load opponents' versions from; required only with such opponents.

    Raises:
        ConfigError: The settings do not fit the league.
    """
    return _module(league.training).algorithm_config(league, interface, storage)


def module_spec(settings: AnyTraining, interface: Interface) -> MultiRLModuleSpec:
    """Return the PolicyModules of all policies. Raises ConfigError for spaces that the algorithm does not support."""
    return _module(settings).module_spec(settings, interface)


def _module(settings: AnyTraining) -> Any:
    """Import `training/algorithms/<name>.py`, and no other algorithm."""
    return import_module(f"training.algorithms.{settings.algorithm}")
