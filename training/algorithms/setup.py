"""What RLlib is told of any league, whatever the algorithm: its environment, policies, runners and learner."""

from functools import partial
from typing import Any

import torch
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.core.learner.learner import Learner
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.env.env_runner import EnvRunner

from league.config import LeagueConfig
from league.errors import ConfigError
from league.interface import Interface
from league.policies.actions import dist_inputs_size
from league.seeds import derive
from league.settings import Storage
from training.algorithms import phases
from training.modules.acting import Acting
from training.sampling.env_runner import INTERFACE, LEAGUE, STORAGE, LockstepEnvRunner, module_spaces


def configure(
    config: AlgorithmConfig,
    league: LeagueConfig,
    interface: Interface,
    storage: Storage | None,
    *,
    modules: MultiRLModuleSpec,
    runner: type[LockstepEnvRunner],
    learner: type[Learner],
) -> None:
    """Tell `config` all but how is learned.

    storage: where the versions are that play as opponents; not needed without. Raises ConfigError where
    `policies_to_train` names a policy that there is not.
    """
    settings = league.training
    phases.check(settings, interface.policy_ids)
    config.environment(
        env_config={
            LEAGUE: league.model_dump(mode="json", by_alias=True),
            INTERFACE: interface.model_dump(mode="json"),
            STORAGE: storage,
        }
    )
    config.multi_agent(
        policies=interface.policy_ids,  # in this order, by which seeded weights and minibatches are drawn
        policy_mapping_fn=lambda agent, *_, **__: interface.policies[agent],
    )
    config.rl_module(rl_module_spec=modules)
    config.env_runners(
        env_runner_cls=runner,
        num_env_runners=settings.runners,
        num_envs_per_env_runner=settings.copies,
        num_gpus_per_env_runner=settings.runner_gpus,
        # The runners have no connector state that could be merged.
        merge_env_runner_states=False,
    )
    # The learner works in the process of the algorithm.
    config.learners(
        learner_class=learner,
        num_learners=0,
        num_gpus_per_learner=settings.gpus,
        add_default_connectors_to_learner_pipeline=False,
    )
    # An environment's fault shall be seen, not tried again for ever; a run that broke off can be resumed.
    config.fault_tolerance(restart_failed_env_runners=False, ignore_env_runner_failures=False)
    config.debugging(seed=settings.seed, log_level="ERROR")
    config.reporting(min_time_s_per_iteration=0)


def specs(interface: Interface, module: type[Acting], model_config: dict[str, Any]) -> dict[str, RLModuleSpec]:
    """Policy id → its module. Raises ConfigError for actions that no policy can have."""
    found = {}
    for policy in interface.policy_ids:
        try:
            dist_inputs_size(interface.of_policy(policy).action)
        except ConfigError as error:
            raise ConfigError(f"policies.{policy}: {error}") from error
        observation, action = module_spaces(interface, policy)
        found[policy] = RLModuleSpec(
            module_class=module, observation_space=observation, action_space=action, model_config=model_config
        )
    return found


def begin_anew(algorithm: Algorithm, steps: int) -> None:
    """Leave all episodes under way, and derive every random choice from here on from the seed and `steps`.

    Called at each checkpoint, and where training goes on from one: both then go on alike.
    """
    # A runner beside remote ones only keeps weights.
    is_local = algorithm.env_runner_group.num_remote_env_runners() == 0
    algorithm.env_runner_group.foreach_env_runner(partial(_begin_anew, steps=steps), local_env_runner=is_local)
    torch.manual_seed(derive(algorithm.config.seed or 0, "learner", steps))


def _begin_anew(runner: EnvRunner, steps: int) -> None:
    runner.begin_anew(steps)
