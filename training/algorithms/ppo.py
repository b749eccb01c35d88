"""PPO by self-play: Schulman et al., 2017, "Proximal policy optimization algorithms", arXiv 1707.06347.

An iteration: `PPO.training_step` here, `PPOLearner.update` in training/learners/ppo.py with train_batch.py, and
`BatchedEnvRunner.sample_chunks` in training/sampling/env_runner.py.

All agents of a policy share one network and learn from their own steps. Illegal actions are masked in the logits, which
keeps the policy gradient valid (Huang and Ontañón, 2020, arXiv 2006.14171). Advantages are generalised advantage
estimates (Schulman et al., 2016, arXiv 1506.02438).
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

from ray.rllib.algorithms import ppo
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModule, MultiRLModuleSpec
from ray.rllib.utils.metrics import (
    ENV_RUNNER_RESULTS,
    ENV_RUNNER_SAMPLING_TIMER,
    LEARNER_RESULTS,
    LEARNER_UPDATE_TIMER,
    NUM_ENV_STEPS_SAMPLED,
    SYNCH_WORKER_WEIGHTS_TIMER,
    TIMERS,
)

from league.config.league import LeagueConfig
from league.config.opponents import OpponentConfig
from league.config.ppo import PPOConfig
from league.errors import ConfigError
from league.interface import Interface
from league.settings import Storage
from league.spaces import ACTION_MASK, inputs
from training.algorithms import rllib_config
from training.algorithms.league_algorithm import LeagueAlgorithm
from training.algorithms.rllib_config import configure, encoder_settings, rl_module_specs
from training.learners.magnet import check_magnet
from training.learners.ppo import PPOLearner, hyperparameters
from training.learners.teacher import check_teacher
from training.modules.actor_critic import ActorCritic, SharedEncoder
from training.sampling.env_runner import LEAGUE, BatchedEnvRunner
from training.sampling.episode_chunks import EpisodeChunks


class PPO(LeagueAlgorithm, ppo.PPO):
    """RLlib's PPO with updates restricted to the policies that currently learn."""

    def training_step(self) -> None:
        """Sample a batch, update the learning policies, and send changed weights to the runners."""
        with self.metrics.log_time((TIMERS, ENV_RUNNER_SAMPLING_TIMER)):
            chunks, results = self.sample_train_batch()
            self.metrics.aggregate(results, key=ENV_RUNNER_RESULTS)
        settings = LeagueConfig.model_validate(self.config.env_config[LEAGUE]).training
        with self.metrics.log_time((TIMERS, LEARNER_UPDATE_TIMER)):
            learned = self.learner_group.update(
                episodes=chunks,
                policies=rllib_config.learning_policies(settings, tuple(self.config.policies), self.iteration),
                progress=self.progress,
                num_epochs=self.config.num_epochs,
                minibatch_size=self.config.minibatch_size,
            )
            self.metrics.aggregate(learned, key=LEARNER_RESULTS)
        with self.metrics.log_time((TIMERS, SYNCH_WORKER_WEIGHTS_TIMER)):
            if changed := list(learned[0]):
                self.env_runner_group.sync_weights(
                    from_worker_or_learner_group=self.learner_group, policies=changed, inference_only=True
                )
        self.exchange_opponents(results, sum(int(result[NUM_ENV_STEPS_SAMPLED]) for result in results))

    def sample_train_batch(self) -> tuple[list[EpisodeChunks], list[dict[str, Any]]]:
        """Sample a train batch from all runners; return the chunks and the runners' metrics.

        Waits for all runners, however long they take. Raises RayActorError if one is lost.
        """
        chunks: list[EpisodeChunks] = []
        results: list[dict[str, Any]] = []
        # With remote runners, the local one only holds weights.
        is_local = self.env_runner_group.num_remote_env_runners() == 0
        sample = partial(_sample_chunks, opponents=self.opponents.active)
        while sum(int(result[NUM_ENV_STEPS_SAMPLED]) for result in results) < self.config.total_train_batch_size:
            for runner_chunks, metrics in self.env_runner_group.foreach_env_runner(sample, local_env_runner=is_local):
                chunks += runner_chunks
                results.append(metrics)
        return chunks, results


def _sample_chunks(
    runner: BatchedEnvRunner, opponents: Sequence[OpponentConfig]
) -> tuple[list[EpisodeChunks], dict[str, Any]]:
    runner.exchange_opponents(opponents)
    return runner.sample_chunks(), runner.get_metrics()


def algorithm_config(league: LeagueConfig, interface: Interface, storage: Storage | None = None) -> ppo.PPOConfig:
    """See `training.algorithms.rllib_config.algorithm_config`."""
    settings = league.training
    assert isinstance(settings, PPOConfig)
    hyperparameters(settings, interface.policy_ids)
    if settings.teacher is not None:
        check_teacher(interface)
    if settings.magnet is not None:
        check_magnet(settings.magnet, interface)
    config = ppo.PPOConfig(algo_class=PPO)
    configure(
        config,
        league,
        interface,
        storage,
        modules=module_spec(settings, interface),
        runner=BatchedEnvRunner,
        learner=PPOLearner,
    )
    config.training(
        train_batch_size_per_learner=settings.train_batch_size,
        minibatch_size=settings.minibatch_size,
        num_epochs=settings.epochs,
        gamma=settings.gamma,
        lambda_=settings.lambda_,
        vf_loss_coeff=settings.value_loss,
        vf_clip_param=float("inf"),
        use_kl_loss=False,
        grad_clip=settings.grad_clip,
        grad_clip_by="global_norm",
    )
    return config


def module_spec(settings: PPOConfig, interface: Interface) -> MultiRLModuleSpec:
    """Return the modules of all policies.

    Raises ConfigError for unsupported spaces, or a shared encoder of different observation spaces.
    """
    model_config = encoder_settings(settings) | {"recurrence": settings.recurrence and settings.recurrence.width}
    if settings.shared_encoder:
        observed = {
            policy: {
                name: leaf
                for name, leaf in inputs(interface.of_policy(policy).observation).items()
                if name != ACTION_MASK
            }
            for policy in interface.policy_ids
        }
        first, *other_policies = observed
        for other in other_policies:
            if observed[other] != observed[first]:
                raise ConfigError(
                    f"training.shared_encoder: policies {first} and {other} have different observation spaces: remove"
                    " it, or pad the observations with SuperSuit"
                )
    return MultiRLModuleSpec(
        multi_rl_module_class=SharedEncoder if settings.shared_encoder else MultiRLModule,
        rl_module_specs=rl_module_specs(interface, ActorCritic, model_config),
    )
