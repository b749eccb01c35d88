"""PPO by self-play: Schulman et al., 2017, "Proximal policy optimization algorithms", arXiv 1707.06347.

All agents of a policy share one network and learn from their own steps at once; illegal actions are masked in the
logits, which keeps the policy gradient right (Huang and Ontañón, 2020, arXiv 2006.14171). Advantages are
generalised advantage estimates (Schulman et al., 2016, arXiv 1506.02438).
"""

from ray.rllib.algorithms import ppo
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec

from league.config import LeagueConfig, PPOConfig
from league.interface import Interface
from league.settings import Storage
from training.learners.ppo import PPOLearner
from training.learners.train_batch import train_batch_connector
from training.modules.actor_critic import ActorCritic
from training.sampling.env_runner import INTERFACE, LEAGUE, STORAGE, LockstepEnvRunner, module_spaces


class PPO(ppo.PPO):
    """RLlib's, but for a directory in the user's home that it makes for results, which are Tune's here."""

    def _setup_logdir(self) -> None:
        pass


def algorithm_config(league: LeagueConfig, interface: Interface, storage: Storage | None = None) -> ppo.PPOConfig:
    """RLlib's configuration of a league's training: our module, runner and learner.

    storage: where the versions are that play as opponents; not needed without.
    """
    settings = league.training
    config = ppo.PPOConfig(algo_class=PPO)
    config.environment(
        env_config={
            LEAGUE: league.model_dump(mode="json", by_alias=True),
            INTERFACE: interface.model_dump(mode="json"),
            STORAGE: storage,
        }
    )
    config.multi_agent(
        policies=set(interface.policy_ids),
        policy_mapping_fn=lambda agent, *_, **__: interface.policies[agent],
    )
    config.rl_module(rl_module_spec=module_spec(settings, interface))
    config.env_runners(
        env_runner_cls=LockstepEnvRunner,
        num_env_runners=settings.runners,
        num_envs_per_env_runner=settings.copies,
        # The runners have no connector state that could be merged.
        merge_env_runner_states=False,
    )
    config.learners(
        learner_class=PPOLearner,
        learner_connector=train_batch_connector(settings.gamma, settings.lambda_),
        add_default_connectors_to_learner_pipeline=False,
    )
    config.training(
        train_batch_size_per_learner=settings.train_batch_size,
        minibatch_size=settings.minibatch_size,
        num_epochs=settings.epochs,
        lr=settings.lr,
        gamma=settings.gamma,
        lambda_=settings.lambda_,
        clip_param=settings.clip,
        entropy_coeff=settings.entropy,
        vf_loss_coeff=settings.value_loss,
        vf_clip_param=float("inf"),
        use_kl_loss=False,
        grad_clip=settings.grad_clip,
        grad_clip_by="global_norm",
    )
    # An environment's fault shall be seen, not tried again for ever; a run that broke off can be resumed.
    config.fault_tolerance(restart_failed_env_runners=False, ignore_env_runner_failures=False)
    config.debugging(seed=settings.seed, log_level="ERROR")
    config.reporting(min_time_s_per_iteration=0)
    return config


def module_spec(settings: PPOConfig, interface: Interface) -> MultiRLModuleSpec:
    """The modules of all policies."""
    specs = {}
    for policy in interface.policy_ids:
        observation, action = module_spaces(interface, policy)
        specs[policy] = RLModuleSpec(
            module_class=ActorCritic,
            observation_space=observation,
            action_space=action,
            model_config={
                "hidden": settings.hidden,
                "convolutions": [(layer.filters, layer.kernel) for layer in settings.convolutions],
            },
        )
    return MultiRLModuleSpec(rl_module_specs=specs)
