"""The RLlib configuration that all algorithms share, and the choice of an algorithm by name or entry point."""

from collections.abc import Sequence
from inspect import isclass
from typing import Any

from ray import cloudpickle
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.core.learner.learner import Learner
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec

from league.config.algorithms import ALGORITHMS, IMPORTED
from league.config.league import LeagueConfig, typed
from league.config.off_policy import OffPolicyConfig
from league.config.ppo import PPOConfig
from league.config.training import PhaseConfig, TrainingSettings
from league.entry_points import import_entry_point
from league.environments.implementation import check_fast_seeds
from league.errors import ConfigError
from league.interface import Interface
from league.policies.actions import dist_inputs_size
from league.results.scoring import scoring
from league.settings import Storage
from training.algorithms.league_algorithm import LeagueAlgorithm
from training.algorithms.resources import resources
from training.modules.policy_module import PolicyModule
from training.sampling.env_runner import INTERFACE, LEAGUE, STORAGE, BatchedEnvRunner, module_spaces
from training.sampling.opponent_scores import is_scored

KEY = "training.algorithm"
PARTS: dict[str, tuple[type, ...]] = {
    "settings_class": (PPOConfig, OffPolicyConfig),
    "module_class": (PolicyModule,),
    "learner_class": (Learner,),
    "runner_class": (BatchedEnvRunner,),
}
"""Attribute of the class of an algorithm → what it is derived from, if no base class has it."""


def algorithm_class(name: str) -> type[LeagueAlgorithm]:
    """Import an algorithm, and no other one.

    Raises ConfigError if there is none, or it lacks one of the PARTS.
    """
    entry_point = f"training.algorithms.{name}:{name.upper()}" if name in ALGORITHMS else name
    imported = import_entry_point(KEY, entry_point)
    if not (isclass(imported) and issubclass(imported, LeagueAlgorithm)):
        raise ConfigError(f"{KEY}: {name}: expected a subclass of PPO or OffPolicy of Policy League, got {imported!r}")
    for part, bases in PARTS.items():
        present, *inherited = [vars(base)[part] for base in imported.__mro__ if part in vars(base)] or [None]
        bases = tuple(inherited[:1]) or bases
        if not (isclass(present) and issubclass(present, bases)):
            names = " or ".join(base.__name__ for base in bases)
            raise ConfigError(f"{KEY}: {name}: {part}: expected a subclass of {names}, got {present!r}")
    return imported


def with_algorithm(league: LeagueConfig) -> LeagueConfig:
    """Return the league with the settings of its algorithm, whose code is imported.

    Raises ConfigError if it cannot be imported, or does not accept the settings.
    """
    settings = league.training
    if settings.algorithm in ALGORITHMS:
        return league
    IMPORTED[settings.algorithm] = algorithm_class(settings.algorithm).settings_class
    try:
        return league.model_copy(update={"training": typed(settings)})
    except ValueError as error:
        raise ConfigError(f"training: {error}") from error


class ImportingConfig(AlgorithmConfig):
    """An AlgorithmConfig that imports the league's algorithm where it is unpickled, before classes of that code."""

    def __reduce_ex__(self, protocol: Any) -> Any:
        if self.env_config[LEAGUE]["training"]["algorithm"] in ALGORITHMS:
            return super().__reduce_ex__(protocol)
        return _unpickle, (type(self), self.env_config[LEAGUE], cloudpickle.dumps(vars(self)))


def _unpickle(cls: type[ImportingConfig], league: dict[str, Any], attributes: bytes) -> ImportingConfig:
    with_algorithm(LeagueConfig.model_validate(league))
    config = cls.__new__(cls)
    config.__dict__.update(cloudpickle.loads(attributes))
    return config


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
) -> None:
    """Set everything in `config` except the algorithm's own hyperparameters.

    Raises ConfigError if `policies_to_train`, `opponents` or `seeds` do not fit the league.
    """
    algorithm: type[LeagueAlgorithm] = config.algo_class
    settings, used = league.training, resources(league, len(interface.agents))
    check_policies_to_train(settings, interface.policy_ids)
    check_opponents(league, interface)
    if settings.seeds == "fast":
        check_fast_seeds(league.training_environment)
        if any(stage.is_random for stage in settings.curriculum):
            raise ConfigError("training.seeds: expected stock, because training.curriculum has random arguments")
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
    config.rl_module(rl_module_spec=algorithm.module_spec(settings, interface))
    config.env_runners(
        env_runner_cls=algorithm.runner_class,
        num_env_runners=used.runners,
        num_envs_per_env_runner=used.num_envs,
        num_gpus_per_env_runner=settings.runner_gpus,
        # The runners have no connector state that could be merged.
        merge_env_runner_states=False,
    )
    # The learner runs in the algorithm's process.
    config.learners(
        learner_class=algorithm.learner_class,
        num_learners=0,
        num_gpus_per_learner=used.gpus,
        add_default_connectors_to_learner_pipeline=False,
    )
    # Report faults of an environment instead of retrying forever; a failed run can be resumed.
    config.fault_tolerance(restart_failed_env_runners=False, ignore_env_runner_failures=False)
    config.debugging(seed=settings.seed, log_level="ERROR")
    config.reporting(min_time_s_per_iteration=0)


def encoder_settings(settings: TrainingSettings) -> dict[str, Any]:
    """Return the part of `model_config` that describes a module's encoder."""
    return {
        "hidden": settings.hidden,
        "convolutions": [(layer.filters, layer.kernel, layer.stride) for layer in settings.convolutions],
        "channels": settings.channels,
        "normalize": settings.normalize_observations,
        "network": settings.network and (settings.network.entry_point, settings.network.kwargs),
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
    league = with_algorithm(league)
    return algorithm_class(league.training.algorithm).algorithm_config(league, interface, storage)


def module_spec(settings: TrainingSettings, interface: Interface) -> MultiRLModuleSpec:
    """Return the PolicyModules of all policies. Raises ConfigError for spaces that the algorithm does not support."""
    return algorithm_class(settings.algorithm).module_spec(settings, interface)
