"""The PPO learner: the clipped surrogate loss and the update loop that minimises it."""

from collections import defaultdict
from collections.abc import Collection, Iterable
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import torch
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.apis.value_function_api import ValueFunctionAPI
from ray.rllib.utils.metrics import ALL_MODULES, NUM_MODULE_STEPS_TRAINED
from torch import Tensor

from league.config.league import LeagueConfig
from league.config.ppo import PPOConfig
from league.config.schedules import Scheduled, ScheduleProgress, scheduled_value
from league.errors import ConfigError
from league.interface import Interface
from training.learners.magnet import Magnet, Previous, magnet, states
from training.learners.optimizer import ClippedAdam, warn_of_dropped_gradients
from training.learners.processor import fast_products, keep_memory
from training.learners.teacher import Teacher
from training.learners.train_batch import (
    Bootstraps,
    Minibatch,
    TrainBatch,
    bootstrap_unless_terminated,
    minibatches,
    train_batch,
)
from training.modules.actor_critic import SharedEncoder
from training.modules.distributions import TorchDistribution
from training.rllib_compat import FixedPoliciesLearner, TrainingData, includes_component
from training.sampling.env_runner import INTERFACE, LEAGUE, STORAGE
from training.sampling.episode_chunks import EpisodeChunks

NOT_STARTED = ScheduleProgress(steps=0, budget=0.0)


@dataclass(frozen=True, slots=True)
class Hyperparameters:
    """The current values of the hyperparameters that each policy may override. See PPOConfig."""

    lr: float
    gamma: float
    lambda_: float
    clip: float
    entropy: float


def hyperparameters(
    settings: PPOConfig, policies: tuple[str, ...], progress: ScheduleProgress = NOT_STARTED
) -> dict[str, Hyperparameters]:
    """Return policy id → its hyperparameters. Raises ConfigError if `per_policy` names an unknown policy."""
    for policy in settings.per_policy:
        if policy not in policies:
            raise ConfigError(f"training.per_policy.{policy}: unknown policy; the league has {', '.join(policies)}")
    names = [field.name for field in fields(Hyperparameters)]
    return {
        policy: Hyperparameters(**{name: scheduled_value(_setting(settings, policy, name), progress) for name in names})
        for policy in policies
    }


def scheduled_hyperparameters(settings: PPOConfig, policy: str) -> tuple[str, ...]:
    """Return the names of a policy's hyperparameters that have a schedule."""
    return tuple(name for name in SCHEDULES if not isinstance(_setting(settings, policy, name), float))


def _setting(settings: PPOConfig, policy: str, name: str) -> Scheduled:
    override = getattr(settings.per_policy.get(policy), name, None)
    return getattr(settings, name) if override is None else override


class PPOLoss(NamedTuple):
    """Scalar parts of the loss; only `total` is meant for gradients."""

    total: Tensor
    policy: Tensor
    value: Tensor
    entropy: Tensor
    clip_fraction: Tensor
    """Fraction of the steps whose probability ratio is outside the clip range."""
    magnet_kl: Tensor
    """Mean divergence from the magnet's reference policy; 0 without a magnet."""
    teacher: Tensor
    """Mean cross-entropy of the teacher's actions; 0 without a teacher."""


def ppo_loss(
    minibatch: Minibatch,
    dist_inputs: Tensor,
    values: Tensor,
    distribution: TorchDistribution,
    *,
    clip: float,
    entropy: float,
    value_loss: float,
    magnet: float = 0.0,
    teacher: float = 0.0,
) -> PPOLoss:
    """Return the clipped surrogate loss. With r = π(a|s) / π_old(a|s), the advantage A, the magnet's policy ρ and the
    teacher's actions b:

        L = −mean(min(r A, clip(r, 1 − ε, 1 + ε) A)) + c_v mean((V − V_target)²) − c_e mean(H(π))
            + c_m mean(KL(π ‖ ρ)) − c_t mean(log π(b|s))

    Schulman et al., 2017, "Proximal policy optimization algorithms", arXiv 1707.06347, equations 7 and 9. The last
    terms: see `training.learners.magnet` and `training.learners.teacher`.

    Args:
        minibatch: k steps.
        dist_inputs: (k, d), the module's current outputs.
        values: (k,), the module's current values V.
        distribution: Of the policy's raw actions.
        clip: ε.
        entropy: c_e.
        value_loss: c_v.
        magnet: c_m; not used if the minibatch has no reference policy.
        teacher: c_t; not used if the minibatch has no actions of a teacher.
    """
    log_p, entropies = distribution.evaluate(dist_inputs, minibatch.actions)
    ratio = torch.exp(log_p - minibatch.log_p)
    clipped = ratio.clamp(1 - clip, 1 + clip)
    policy = -torch.minimum(ratio * minibatch.advantages, clipped * minibatch.advantages).mean()
    value = (values - minibatch.targets).square().mean()
    mean_entropy = entropies.mean()
    total = policy + value_loss * value - entropy * mean_entropy
    magnet_kl = torch.zeros_like(total)
    if minibatch.magnet is not None:
        magnet_kl = distribution.divergence(dist_inputs, minibatch.magnet).mean()
        total = total + magnet * magnet_kl
    cross_entropy = torch.zeros_like(total)
    if minibatch.taught is not None:
        cross_entropy = -distribution.evaluate(dist_inputs, minibatch.taught)[0].mean()
        total = total + teacher * cross_entropy
    return PPOLoss(total, policy, value, mean_entropy, (clipped != ratio).float().mean(), magnet_kl, cross_entropy)


MAGNET_KL, MAGNET_WEIGHT = "magnet_kl", "magnet_weight"
"""Logged only with a magnet, the weight only if it has a schedule."""
TEACHER_LOSS, TEACHER_WEIGHT = "teacher_loss", "teacher_weight"
"""Logged only with a teacher: the loss as long as the weight is not 0, the weight only if it has a schedule."""
STATISTICS = ("policy_loss", "vf_loss", "entropy", "clip_fraction", "gradient_norm")
"""Logged per policy: means over the minibatches of an update."""
EXPLAINED_VARIANCE = "vf_explained_var"
KL = "kl"
"""Mean Kullback–Leibler divergence between the policies before and after an update."""
SCHEDULES = {"lr": "lr", "clip": "clip", "entropy": "entropy_coefficient"}
"""Hyperparameters that can have a schedule → their metrics, which are logged only then."""
MAGNET = "magnet"
"""Key of the magnet's snapshot in the state."""
KL_STEPS = 1024
"""Number of steps for estimating the divergence."""
ADAM_EPSILON = 1e-5
"""As in the reference implementation of PPO (openai/baselines)."""


class PPOLearner(FixedPoliciesLearner):
    """Updates on whole columns of arrays.

    RLlib's loop passes each minibatch through several layers of dictionaries, counters and logs, which costs more than
    the arithmetic of small networks. A policy without steps in the episodes, or that does not currently learn, keeps
    its weights and optimiser state.
    """

    bootstraps: Bootstraps = staticmethod(bootstrap_unless_terminated)
    """Selects the chunks whose last observation is bootstrapped from."""

    def build(self) -> None:
        settings = LeagueConfig.model_validate(self.config.env_config[LEAGUE]).training
        assert isinstance(settings, PPOConfig)
        self.settings = settings
        self._set_hyperparameters(NOT_STARTED)
        keep_memory()
        super().build()
        interface = Interface.model_validate(self.config.env_config[INTERFACE])
        storage = self.config.env_config.get(STORAGE)
        self._magnet: Magnet | None = None
        if settings.magnet is not None:
            self._magnet = magnet(settings.magnet, self.module, interface, storage)
        self._teacher: Teacher | None = None
        if settings.teacher is not None:
            self._teacher = Teacher(settings.teacher, interface, storage, settings.seed)

    @classmethod
    def rl_module_required_apis(cls) -> list[type]:
        return [ValueFunctionAPI]

    def configure_optimizers(self) -> None:
        """Create an Adam optimiser for each policy's own parameters, and one for a shared encoder."""
        shared = self.module.encoder if isinstance(self.module, SharedEncoder) else None
        common = list(shared.parameters()) if shared is not None else []
        self._optimizers: dict[str, ClippedAdam] = {}
        for policy, module in self.module.items():
            own_parameters = [
                parameter for parameter in module.parameters() if not any(parameter is other for other in common)
            ]
            self._add_optimizer(policy, own_parameters)
        if common:
            self._add_optimizer(ALL_MODULES, common)

    def update(
        self,
        *,
        training_data: TrainingData,
        policies: Collection[str] | None = None,
        progress: ScheduleProgress = NOT_STARTED,
        num_epochs: int = 1,
        minibatch_size: int | None = None,
        **_: Any,
    ) -> dict[str, Any]:
        """Update the policies on sampled chunks.

        Args:
            training_data: Contains the EpisodeChunks of a sample in place of episodes.
            policies: The policies to update; by default all.
            progress: Where the schedules are.
            num_epochs: Passes over the data.
            minibatch_size: Steps per minibatch of the policy with the most steps.

        Returns:
            Policy id → metrics, for the policies that were updated.
        """
        if isinstance(self._magnet, Previous):
            self._magnet.before_update(self.weights_version, self.module)
        self.weights_version += 1
        self._set_hyperparameters(progress)
        with fast_products():
            batches = self._batches(training_data.episodes, self.module.keys() if policies is None else policies)
            if batches:
                size = minibatch_size or max(len(batch) for batch in batches.values())
                self._log(batches, self._gradient_steps(minibatches(batches, size=size, epochs=num_epochs)))
                warn_of_dropped_gradients(self._optimizers)
        metrics = self.metrics.reduce()
        # RLlib reports NaN for policies that were logged earlier but not in this update.
        return {policy: metrics[policy] for policy in batches}

    def _gradient_steps(self, drawn: Iterable[dict[str, Minibatch]]) -> dict[str, list[Tensor]]:
        """Take a gradient step per minibatch; return policy id → statistics of its steps."""
        for name, optimizer in self._optimizers.items():
            optimizer.param_groups[0]["lr"] = self._lr(name)
        statistics = defaultdict(list)
        for minibatch in drawn:
            for optimizer in self._optimizers.values():
                optimizer.zero_grad()
            answers = self.module.forward_train({policy: steps.inputs for policy, steps in minibatch.items()})
            losses = {
                policy: self.compute_loss_for_module(module_id=policy, batch=steps, fwd_out=answers[policy])
                for policy, steps in minibatch.items()
            }
            torch.autograd.backward([loss.total for loss in losses.values()])
            names = [name for name in self._optimizers if name in minibatch or name == ALL_MODULES]
            norms = {name: self._optimizers[name].clip_and_step() for name in names}
            for policy, loss in losses.items():
                row = torch.stack([*loss[1:-2], norms[policy], loss.magnet_kl, loss.teacher])
                statistics[policy].append(row.detach())
        return statistics

    def _set_hyperparameters(self, progress: ScheduleProgress) -> None:
        self.hyperparameters = hyperparameters(self.settings, tuple(self.config.policies), progress)
        self._common_lr = scheduled_value(self.settings.lr, progress)
        self._magnet_weight = scheduled_value(self.settings.magnet.weight, progress) if self.settings.magnet else 0.0
        self._teacher_weight = scheduled_value(self.settings.teacher.weight, progress) if self.settings.teacher else 0.0

    def _batches(self, sampled: Iterable[EpisodeChunks], policies: Collection[str]) -> dict[str, TrainBatch]:
        chunks = defaultdict(list)
        for policy_chunks in sampled:
            if policy_chunks.policy in policies:
                chunks[policy_chunks.policy].append(policy_chunks)
        recurrence = self.settings.recurrence
        batches = {}
        for policy, module in self.module.items():
            if policy not in chunks:
                continue
            batch = train_batch(
                module,
                chunks[policy],
                gamma=self.hyperparameters[policy].gamma,
                lambda_=self.hyperparameters[policy].lambda_,
                sequence=recurrence.sequence if recurrence else None,
                bootstraps=self.bootstraps,
            )
            if self._magnet is not None:
                batch = replace(batch, magnet=self._magnet.dist_inputs(policy, batch))
            if self._teacher is not None and self._teacher_weight:
                batch = replace(batch, taught=self._teacher.actions(policy, batch, self.weights_version))
            batches[policy] = batch
        return batches

    def compute_loss_for_module(
        self, *, module_id: str, batch: Minibatch, fwd_out: dict[str, Tensor], **_: Any
    ) -> PPOLoss:
        """Return the loss of one policy on some steps."""
        return ppo_loss(
            batch,
            fwd_out[Columns.ACTION_DIST_INPUTS],
            fwd_out[Columns.VF_PREDS],
            self.module[module_id].distribution,
            clip=self.hyperparameters[module_id].clip,
            entropy=self.hyperparameters[module_id].entropy,
            value_loss=self.settings.value_loss,
            magnet=self._magnet_weight,
            teacher=self._teacher_weight,
        )

    def _lr(self, name: str) -> float:
        """Return the current learning rate of a policy, or of a shared encoder."""
        return self._common_lr if name == ALL_MODULES else self.hyperparameters[name].lr

    def get_state(
        self,
        components: str | Collection[str] | None = None,
        *,
        not_components: str | Collection[str] | None = None,
        **kwargs: Any,
    ) -> dict[str, Any]:
        """Return RLlib's state with the snapshot of the magnet, if it has one."""
        state: dict[str, Any] = super().get_state(components, not_components=not_components, **kwargs)
        if isinstance(self._magnet, Previous) and includes_component(self, MAGNET, components, not_components):
            state[MAGNET] = self._magnet.get_state()
        return state

    def set_state(self, state: dict[str, Any]) -> None:
        super().set_state(state)
        if isinstance(self._magnet, Previous):
            # A run without a magnet, which this one continues, has no snapshot.
            self._magnet.set_state(state.get(MAGNET) or states(self.module))

    def _add_optimizer(self, name: str, parameters: list[torch.nn.Parameter]) -> None:
        optimizer = ClippedAdam(parameters, lr=self._lr(name), max_norm=self.settings.grad_clip, eps=ADAM_EPSILON)
        self.register_optimizer(module_id=name, optimizer=optimizer, params=parameters)
        self._optimizers[name] = optimizer

    def _log(self, batches: dict[str, TrainBatch], statistics: dict[str, list[Tensor]]) -> None:
        divergences = self._divergences(batches)
        for policy, batch in batches.items():
            means = torch.stack(statistics[policy]).mean(0).tolist()
            logged = dict(zip((*STATISTICS, MAGNET_KL, TEACHER_LOSS), means, strict=True))
            logged |= {EXPLAINED_VARIANCE: batch.explained_variance, KL: divergences[policy]}
            scheduled = scheduled_hyperparameters(self.settings, policy)
            logged |= {SCHEDULES[name]: getattr(self.hyperparameters[policy], name) for name in scheduled}
            if self.settings.magnet is None:
                del logged[MAGNET_KL]
            elif not isinstance(self.settings.magnet.weight, float):
                logged[MAGNET_WEIGHT] = self._magnet_weight
            if not self._teacher_weight:
                del logged[TEACHER_LOSS]
            if self.settings.teacher is not None and not isinstance(self.settings.teacher.weight, float):
                logged[TEACHER_WEIGHT] = self._teacher_weight
            self.metrics.log_dict(logged, key=policy, window=1)
            self.metrics.log_value((policy, NUM_MODULE_STEPS_TRAINED), len(batch), reduce="sum")

    @torch.no_grad()
    def _divergences(self, batches: dict[str, TrainBatch]) -> dict[str, float]:
        """Estimate each policy's divergence from before the update, on about KL_STEPS steps."""
        samples = {}
        for policy, batch in batches.items():
            stride = -(-len(batch) // KL_STEPS)
            samples[policy] = batch.take(torch.arange(0, batch.units, stride, device=batch.acted.device))
        answers = self.module.forward_train({policy: steps.inputs for policy, steps in samples.items()})
        return {
            policy: float(
                self.module[policy]
                .distribution.divergence(steps.dist_inputs, answers[policy][Columns.ACTION_DIST_INPUTS])
                .mean()
            )
            for policy, steps in samples.items()
        }
