"""PPO by self-play: Schulman et al., 2017, "Proximal policy optimization algorithms", arXiv 1707.06347.

An iteration: `PPO.training_step` here, `PPOLearner.update` in training/learners/ppo.py with train_batch.py, and
`BatchedEnvRunner.sample_chunks` in training/sampling/env_runner.py.

Remote runners sample while the learner updates: update k learns from actions of the weights after update k − 1 − lag
(`training.lag`), or after the last reset of the episodes if that is later. Probability ratios and the divergence are
relative to these weights. Values and the magnet `previous` are those of the weights before update k.

All agents of a policy share one network and learn from their own steps. Illegal actions are masked in the logits, which
keeps the policy gradient valid (Huang and Ontañón, 2020, arXiv 2006.14171). Advantages are generalised advantage
estimates (Schulman et al., 2016, arXiv 1506.02438). With a central critic (`training.critic`), this is MAPPO (Yu et
al., 2022, arXiv 2103.01955): runners record what the critic gets, and only the learner has critics.
"""

from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import Any, ClassVar

from ray.rllib.algorithms import ppo
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModule, MultiRLModuleSpec
from ray.rllib.utils.metrics import (
    LEARNER_RESULTS,
    LEARNER_UPDATE_TIMER,
    NUM_ENV_STEPS_SAMPLED,
    SYNCH_WORKER_WEIGHTS_TIMER,
    TIMERS,
)

from league.config.league import LeagueConfig
from league.config.opponents import OpponentConfig
from league.config.ppo import PPOConfig
from league.config.schedules import scheduled_value
from league.errors import ConfigError
from league.interface import Interface
from league.settings import Storage
from league.spaces import ACTION_MASK, inputs
from training.algorithms import rllib_config
from training.algorithms.further_learners import FurtherLearners
from training.algorithms.league_algorithm import LeagueAlgorithm, NoSimulator
from training.algorithms.metrics import PPO_METRICS
from training.algorithms.resources import resources, scaled
from training.algorithms.rllib_config import ImportingConfig, configure, encoder_settings, rl_module_specs
from training.learners.magnet import check_magnet
from training.learners.ppo import PPOLearner, hyperparameters
from training.modules.actor_critic import ActorCritic, SharedEncoder
from training.rllib_compat import local_learner
from training.sampling.env_runner import INTERFACE, LEAGUE, BatchedEnvRunner
from training.sampling.episode_chunks import EpisodeChunks
from training.sampling.teacher import check_teacher

Sample = tuple[list[EpisodeChunks], dict[str, Any]]
"""The chunks and the metrics of one runner."""


class PPORLlibConfig(ImportingConfig, ppo.PPOConfig):
    """RLlib's configuration of PPO."""


class PPO(LeagueAlgorithm, ppo.PPO):
    """RLlib's PPO with updates restricted to the policies that currently learn."""

    settings_class: ClassVar[type[PPOConfig]] = PPOConfig
    module_class = ActorCritic
    learner_class = PPOLearner
    runner_class = BatchedEnvRunner
    curves = PPO_METRICS
    _requested = _received = 0
    """Numbers of samples of remote runners. The samples between them are in flight."""
    _samples: tuple[Sample, ...] = ()
    """Of some runners, while others had no simulator."""

    @classmethod
    def algorithm_config(cls, league: LeagueConfig, interface: Interface, storage: Storage | None) -> ppo.PPOConfig:
        """See `training.algorithms.rllib_config.algorithm_config`."""
        used = resources(league, len(interface.agents))
        settings = scaled(league.training, used.batch_scale)
        assert isinstance(settings, PPOConfig)
        hyperparameters(settings, interface.policy_ids)
        if settings.critic == "central" and len(interface.agents) == 1:
            raise ConfigError("training.critic: central needs several agents, but the environment has one: use own")
        if settings.teacher is not None:
            check_teacher(interface)
        if settings.magnet is not None:
            check_magnet(settings.magnet, interface)
        config = PPORLlibConfig(algo_class=cls)
        configure(config, league, interface, storage)
        # RLlib does not send weights to a runner that has not received those of this number of earlier updates.
        config.env_runners(max_requests_in_flight_per_env_runner=settings.lag + 2)
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

    @classmethod
    def module_spec(cls, settings: PPOConfig, interface: Interface) -> MultiRLModuleSpec:
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
                        f"training.shared_encoder: policies {first} and {other} have different observation spaces:"
                        " remove it, or pad the observations with SuperSuit"
                    )
        return MultiRLModuleSpec(
            multi_rl_module_class=SharedEncoder if settings.shared_encoder else MultiRLModule,
            rl_module_specs=rl_module_specs(interface, cls.module_class, model_config),
        )

    def setup(self, config: AlgorithmConfig) -> None:
        # Before the runners, which would also start where only learners fit.
        league = LeagueConfig.model_validate(config.env_config[LEAGUE])
        interface = Interface.model_validate(config.env_config[INTERFACE])
        self.further_learners = FurtherLearners(config, resources(league, len(interface.agents)).learners)
        super().setup(config)
        self.further_learners.connect(local_learner(self))

    def cleanup(self) -> None:
        self.further_learners.end()
        super().cleanup()

    def training_step(self) -> None:
        """Sample a batch, update the learning policies, and send changed weights to the runners."""
        policies = self._learning_policies()
        with self.metrics.log_time((TIMERS, self.sampling_timer)):
            chunks, results = self.sample_train_batch()
            self.add_results(results)
        with self.metrics.log_time((TIMERS, LEARNER_UPDATE_TIMER)):
            arguments = {
                "episodes": chunks,
                "policies": policies,
                "progress": self.progress,
                "num_epochs": self.config.num_epochs,
                "minibatch_size": self.config.minibatch_size,
            }
            with self.further_learners.updating(**arguments):
                learned = self.learner_group.update(**arguments)
            self.metrics.aggregate(learned, key=LEARNER_RESULTS)
        with self.metrics.log_time((TIMERS, SYNCH_WORKER_WEIGHTS_TIMER)):
            if changed := list(learned[0]):
                self.env_runner_group.sync_weights(
                    from_worker_or_learner_group=self.learner_group, policies=changed, inference_only=True
                )
        self.exchange_opponents(results, sum(int(result[NUM_ENV_STEPS_SAMPLED]) for result in results))

    def sample_train_batch(self) -> tuple[list[EpisodeChunks], list[dict[str, Any]]]:
        """Return the next train batch, as the chunks and the metrics of all runners.

        First requests samples from remote runners until `lag` further ones are in flight. A runner answers requests and
        receives weights in the order in which they were sent. Waits for all runners, however long they take. Raises
        RayActorError if one is lost, and NoSimulator.
        """
        settings = self._settings
        is_taught = settings.teacher is not None and scheduled_value(settings.teacher.weight, self.progress) > 0

        def sample(ahead: int) -> Callable[[BatchedEnvRunner], Sample | None]:
            taught = self._learning_policies(ahead) if is_taught else ()
            return partial(_sample_chunks, opponents=self.opponents.active, taught=taught)

        if not (runners := self.env_runner_group.num_remote_env_runners()):
            samples = self.env_runner_group.foreach_env_runner(sample(0))
        else:
            while (ahead := self._requested - self._received) <= settings.lag:
                self.env_runner_group.foreach_env_runner_async(sample(ahead), tag=f"sample {self._requested}")
                self._requested += 1
            samples = self._receive_sample()
        self._samples += tuple(part for part in samples if part is not None)
        if len(self._samples) < max(runners, 1):
            raise NoSimulator
        complete, self._samples = self._samples, ()
        return [part for chunks, _ in complete for part in chunks], [metrics for _, metrics in complete]

    def reset_episodes(self, steps: int) -> None:
        """See `LeagueAlgorithm.reset_episodes`. Drops the samples in flight, which no metric contains."""
        while self._received < self._requested:
            self._receive_sample()
        self._samples = ()
        super().reset_episodes(steps)

    @property
    def _settings(self) -> PPOConfig:
        settings = self.league.training
        assert isinstance(settings, PPOConfig)
        return settings

    def _learning_policies(self, ahead: int = 0) -> tuple[str, ...]:
        """Return the policies to update after `ahead` further updates."""
        return rllib_config.learning_policies(self._settings, tuple(self.config.policies), self.iteration + ahead)

    def _receive_sample(self) -> list[Sample | None]:
        tag = f"sample {self._received}"
        self._received += 1
        samples = self.env_runner_group.fetch_ready_async_reqs(tags=tag, timeout_seconds=None)
        return [sample for _, sample in samples]


def _sample_chunks(
    runner: BatchedEnvRunner, opponents: Sequence[OpponentConfig], taught: Collection[str]
) -> Sample | None:
    with runner.timed_sample():
        runner.exchange_opponents(opponents)
        chunks = runner.sample_chunks(taught=taught)
    return (chunks, runner.get_metrics()) if chunks else None
