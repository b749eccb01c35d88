"""PPO by self-play: Schulman et al., 2017, "Proximal policy optimization algorithms", arXiv 1707.06347.

All agents of a policy share one network and learn from their own steps at once; illegal actions are masked in the
logits, which keeps the policy gradient right (Huang and Ontañón, 2020, arXiv 2006.14171). Advantages are
generalised advantage estimates (Schulman et al., 2016, arXiv 1506.02438).
"""

from collections.abc import Collection

from ray.rllib.algorithms import ppo
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModule, MultiRLModuleSpec
from ray.rllib.execution.rollout_ops import synchronous_parallel_sample
from ray.rllib.utils.metrics import (
    ENV_RUNNER_RESULTS,
    ENV_RUNNER_SAMPLING_TIMER,
    LEARNER_RESULTS,
    LEARNER_UPDATE_TIMER,
    SYNCH_WORKER_WEIGHTS_TIMER,
    TIMERS,
)

from league.config import LeagueConfig
from league.errors import ConfigError
from league.interface import Interface
from league.settings import Storage
from league.spaces import ACTION_MASK, inputs
from league.training_config import PPOConfig
from training.algorithms import phases
from training.algorithms.setup import begin_anew, configure, specs
from training.learners.hyperparameters import hyperparameters
from training.learners.ppo import PPOLearner
from training.modules.actor_critic import ActorCritic
from training.modules.shared_encoder import SharedEncoder
from training.sampling.env_runner import LEAGUE, LockstepEnvRunner


class PPO(ppo.PPO):
    """RLlib's Algorithm, whose updates reach those policies that learn at the time."""

    def training_step(self) -> None:
        """Sample a batch, learn from it, and give the runners the weights that have changed."""
        with self.metrics.log_time((TIMERS, ENV_RUNNER_SAMPLING_TIMER)):
            episodes, results = synchronous_parallel_sample(
                worker_set=self.env_runner_group,
                max_env_steps=self.config.total_train_batch_size,
                sample_timeout_s=self.config.sample_timeout_s,
                _uses_new_env_runners=True,
                _return_metrics=True,
            )
            self.metrics.aggregate(results, key=ENV_RUNNER_RESULTS)
        with self.metrics.log_time((TIMERS, LEARNER_UPDATE_TIMER)):
            learned = self.learner_group.update(
                episodes=episodes,
                policies=self._learning(),
                num_epochs=self.config.num_epochs,
                minibatch_size=self.config.minibatch_size,
            )
            self.metrics.aggregate(learned, key=LEARNER_RESULTS)
        with self.metrics.log_time((TIMERS, SYNCH_WORKER_WEIGHTS_TIMER)):
            if changed := list(learned[0]):
                self.env_runner_group.sync_weights(
                    from_worker_or_learner_group=self.learner_group, policies=changed, inference_only=True
                )

    def begin_anew(self, steps: int) -> None:
        """Leave all episodes under way, and derive every random choice from here on from the seed and `steps`."""
        begin_anew(self, steps)

    def _learning(self) -> Collection[str]:
        settings = LeagueConfig.model_validate(self.config.env_config[LEAGUE]).training
        return phases.learning(settings, tuple(self.config.policies), self.iteration)

    def _setup_logdir(self) -> None:
        """RLlib makes a directory for results in the user's home, which are Tune's here."""


def algorithm_config(league: LeagueConfig, interface: Interface, storage: Storage | None = None) -> ppo.PPOConfig:
    """RLlib's configuration of a league's training: our module, runner and learner.

    storage: where the versions are that play as opponents; not needed without.
    Raises ConfigError where settings name policies that there are not, or spaces do not fit the module.
    """
    settings = league.training
    assert isinstance(settings, PPOConfig)
    hyperparameters(settings, interface.policy_ids)
    config = ppo.PPOConfig(algo_class=PPO)
    configure(
        config,
        league,
        interface,
        storage,
        modules=module_spec(settings, interface),
        runner=LockstepEnvRunner,
        learner=PPOLearner,
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
    return config


def module_spec(settings: PPOConfig, interface: Interface) -> MultiRLModuleSpec:
    """The modules of all policies. Raises ConfigError for spaces that they cannot have."""
    model_config = {
        "hidden": settings.hidden,
        "convolutions": [(layer.filters, layer.kernel, layer.stride) for layer in settings.convolutions],
        "recurrence": settings.recurrence and settings.recurrence.width,
        "normalize": settings.normalize_observations,
    }
    if settings.shared_encoder:
        _check_shared(interface)
    return MultiRLModuleSpec(
        multi_rl_module_class=SharedEncoder if settings.shared_encoder else MultiRLModule,
        rl_module_specs=specs(interface, ActorCritic, model_config),
    )


def _check_shared(interface: Interface) -> None:
    """One encoder reads what all policies observe, action masks apart."""
    observed = {
        policy: {
            name: leaf for name, leaf in inputs(interface.of_policy(policy).observation).items() if name != ACTION_MASK
        }
        for policy in interface.policy_ids
    }
    first, *others = observed
    for other in others:
        if observed[other] != observed[first]:
            raise ConfigError(
                f"training.shared_encoder: policies {first} and {other} observe different spaces: leave it out, or pad"
                " the observations with SuperSuit"
            )
