"""The PPO learner: the clipped surrogate loss and the update loop that minimises it."""

import math
from collections import defaultdict
from collections.abc import Collection, Iterable
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import gymnasium
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
from training.learners.optimizer import ClippedAdam, check_gradients
from training.learners.processor import fast_products, keep_memory
from training.learners.ranks import ALONE, Rank
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
from training.modules.encoder import Encoder
from training.modules.value_function import CentralCritic, ReturnNormalization
from training.rllib_compat import FixedPoliciesLearner, TrainingData, includes_component
from training.sampling.central_observations import central_space
from training.sampling.env_runner import INTERFACE, LEAGUE, STORAGE
from training.sampling.episode_chunks import EpisodeChunks

WARM_UP = 2**20
"""Actions, including those of parent versions, over which the learning rate of larger batches grows."""
NOT_STARTED = ScheduleProgress(steps=0, budget=0.0)


@dataclass(frozen=True, slots=True)
class Hyperparameters:
    """The current values of the hyperparameters that each policy may override. See PPOConfig."""

    lr: float
    gamma: float
    lambda_: float
    clip: float
    entropy: float


def learning_rate_factor(settings: PPOConfig, progress: ScheduleProgress) -> float:
    """Return by what the learning rates are multiplied for larger batches: from 1 to √batch_scale.

    Adam's steps are noisy by 1/√size (Malladi et al., 2022, "On the SDEs and scaling rules for adaptive gradient
    algorithms", arXiv 2205.10287). The factor grows linearly over WARM_UP actions, as gradients change fast at first.
    """
    scale = 1 if settings.batch_scale == "auto" else settings.batch_scale
    return 1 + (math.sqrt(scale) - 1) * min(progress.steps / WARM_UP, 1.0)


def hyperparameters(
    settings: PPOConfig, policies: tuple[str, ...], progress: ScheduleProgress = NOT_STARTED
) -> dict[str, Hyperparameters]:
    """Return policy id → its hyperparameters. Raises ConfigError if `per_policy` names an unknown policy."""
    for policy in settings.per_policy:
        if policy not in policies:
            raise ConfigError(f"training.per_policy.{policy}: unknown policy; the league has {', '.join(policies)}")
    names, factor = [field.name for field in fields(Hyperparameters)], learning_rate_factor(settings, progress)
    values = {
        policy: Hyperparameters(**{name: scheduled_value(_setting(settings, policy, name), progress) for name in names})
        for policy in policies
    }
    return {policy: replace(value, lr=value.lr * factor) for policy, value in values.items()}


def scheduled_hyperparameters(settings: PPOConfig, policy: str) -> tuple[str, ...]:
    """Return the names of a policy's hyperparameters that have a schedule."""
    return tuple(name for name in SCHEDULES if not isinstance(_setting(settings, policy, name), float))


def _setting(settings: PPOConfig, policy: str, name: str) -> Scheduled:
    override = getattr(settings.per_policy.get(policy), name, None)
    return getattr(settings, name) if override is None else override


class PPOLoss(NamedTuple):
    """Scalar parts of the loss, and the gradient of their weighted sum."""

    policy: Tensor
    value: Tensor
    entropy: Tensor
    clip_fraction: Tensor
    """Fraction of the steps whose probability ratio is outside the clip range."""
    magnet_kl: Tensor | None
    """Mean divergence from the magnet's reference policy."""
    teacher: Tensor | None
    """Mean cross-entropy of the teacher's actions."""
    outputs: tuple[Tensor, Tensor]
    """The module's outputs: the inputs of the action distribution, (k, d), and the values, (k,)."""
    gradients: tuple[Tensor, Tensor]
    """The gradient by each output, times the minibatch's fraction of the steps of all learners."""


@torch.no_grad()
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
    terms: see `training.learners.magnet` and `training.sampling.teacher`.

    The gradient is computed by its formula, since automatic differentiation takes longer than these operations. Of a
    step,

        ∂L/∂ log π(a|s) = −r A / k, or 0 where the clipped term is the smaller one,    ∂L/∂V = 2 c_v (V − V_target) / k

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
    surrogate, bound = ratio * minibatch.advantages, clipped * minibatch.advantages
    error = values - minibatch.targets
    share = minibatch.fraction / len(values)
    by_log_p = torch.where(surrogate > bound, 0.0, surrogate) * -share
    gradient = distribution.gradient(dist_inputs, minibatch.actions, by_log_p, -entropy * share)
    magnet_kl = cross_entropy = None
    if minibatch.magnet is not None:
        magnet_kl = distribution.divergence(dist_inputs, minibatch.magnet).mean()
        gradient = gradient + magnet * share * distribution.divergence_gradient(dist_inputs, minibatch.magnet)
    if minibatch.taught is not None:
        taught_log_p, _ = distribution.evaluate(dist_inputs, minibatch.taught)
        cross_entropy = -taught_log_p.mean()
        by_taught_log_p = torch.full_like(taught_log_p, -teacher * share)
        gradient = gradient + distribution.gradient(dist_inputs, minibatch.taught, by_taught_log_p, 0.0)
    return PPOLoss(
        policy=-torch.minimum(surrogate, bound).mean(),
        value=error.square().mean(),
        entropy=entropies.mean(),
        clip_fraction=(clipped != ratio).mean(dtype=torch.float32),
        magnet_kl=magnet_kl,
        teacher=cross_entropy,
        outputs=(dist_inputs, values),
        gradients=(gradient, error * (2 * value_loss * share)),
    )


MAGNET_KL, MAGNET_WEIGHT = "magnet_kl", "magnet_weight"
"""Logged only with a magnet, the weight only if it has a schedule."""
TEACHER_LOSS, TEACHER_WEIGHT = "teacher_loss", "teacher_weight"
"""Logged only with a teacher: the loss as long as the weight is not 0, the weight only if it has a schedule."""
STATISTICS = ("policy_loss", "vf_loss", "entropy", "clip_fraction", "gradient_norm")
"""Logged per policy: means over the minibatches of an update."""
EXPLAINED_VARIANCE = "vf_explained_var"
KL = "kl"
"""Mean Kullback–Leibler divergence of the policy after an update from the one that sampled, lag + 1 updates before."""
SCHEDULES = {"lr": "lr", "clip": "clip", "entropy": "entropy_coefficient"}
"""Hyperparameters that can have a schedule → their metrics, which are logged only then."""
MAGNET = "magnet"
"""Key of the magnet's snapshot in the state."""
CRITIC = ".critic"
"""Follows the policy's id in the name of a central critic's optimiser; policy ids contain no dot."""
CRITICS, SCALES = "critics", "scales"
"""Keys of the central critics and the units of returns in the state."""
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
    rank: Rank = ALONE
    """The place among the learners of the run. All call `update` with the same arguments, from the same state."""

    def build(self) -> None:
        league = LeagueConfig.model_validate(self.config.env_config[LEAGUE])
        interface = Interface.model_validate(self.config.env_config[INTERFACE])
        settings = league.training
        assert isinstance(settings, PPOConfig)
        self.settings = settings
        self._central = (
            {} if settings.critic == "own" else central_space(settings.critic, league.environment, interface)
        )
        self._set_hyperparameters(NOT_STARTED)
        keep_memory()
        super().build()
        storage = self.config.env_config.get(STORAGE)
        self._magnet: Magnet | None = None
        if settings.magnet is not None:
            self._magnet = magnet(settings.magnet, self.module, interface, storage)

    @classmethod
    def rl_module_required_apis(cls) -> list[type]:
        return [ValueFunctionAPI]

    def configure_optimizers(self) -> None:
        """Create what values need besides the modules, and an Adam optimiser for each policy's own parameters, for each
        central critic, and for a shared encoder.
        """
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
        self._critics: dict[str, CentralCritic] = {}
        if self._central:
            convolutions = [(layer.filters, layer.kernel, layer.stride) for layer in self.settings.convolutions]
            for policy, module in self.module.items():
                space = gymnasium.spaces.Dict({**module.observation_space.spaces, **self._central})
                encoder = Encoder(
                    space,
                    self.settings.hidden,
                    convolutions,
                    self.settings.normalize_observations,
                    self.settings.channels,
                )
                self._critics[policy] = CentralCritic(encoder).to(self.device)
        for policy, critic in self._critics.items():
            self._add_optimizer(policy + CRITIC, list(critic.parameters()))
        normalizes = self.settings.normalize_values
        self._scales = {policy: ReturnNormalization() for policy, _ in self.module.items() if normalizes}

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
                drawn = minibatches(batches, size=size, epochs=num_epochs, rank=self.rank)
                self._log(batches, self._gradient_steps(drawn))
                check_gradients(self._optimizers)
        metrics = self.metrics.reduce()
        # RLlib reports NaN for policies that were logged earlier but not in this update.
        return {policy: metrics[policy] for policy in batches}

    def _gradient_steps(self, drawn: Iterable[dict[str, Minibatch]]) -> dict[str, list[Tensor]]:
        """Take a gradient step per minibatch; return policy id → statistics of its steps."""
        for name, optimizer in self._optimizers.items():
            optimizer.param_groups[0]["lr"] = self._lr(name)
        statistics = defaultdict(list)
        for minibatch in drawn:
            answers = self.module.forward_train({policy: steps.inputs for policy, steps in minibatch.items()})
            losses = {
                policy: self.compute_loss_for_module(module_id=policy, batch=steps, fwd_out=answers[policy])
                for policy, steps in minibatch.items()
            }
            torch.autograd.backward(
                [output for loss in losses.values() for output in loss.outputs],
                [gradient for loss in losses.values() for gradient in loss.gradients],
            )
            if self.rank.count > 1:
                groups = [group for optimizer in self._optimizers.values() for group in optimizer.param_groups]
                self.rank.add([p.grad for group in groups for p in group["params"] if p.grad is not None])
            names = [name for name in self._optimizers if name.removesuffix(CRITIC) in minibatch or name == ALL_MODULES]
            norms = {name: self._optimizers[name].clip_and_step() for name in names}
            for policy, loss in losses.items():
                further = [part for part in (loss.magnet_kl, loss.teacher) if part is not None]
                row = torch.stack([loss.policy, loss.value, loss.entropy, loss.clip_fraction, norms[policy], *further])
                statistics[policy].append(row if self.rank.count == 1 else row * minibatch[policy].fraction)
        self.rank.add([row for rows in statistics.values() for row in rows])
        return statistics

    def _set_hyperparameters(self, progress: ScheduleProgress) -> None:
        self.hyperparameters = hyperparameters(self.settings, tuple(self.config.policies), progress)
        self._common_lr = scheduled_value(self.settings.lr, progress) * learning_rate_factor(self.settings, progress)
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
                critic=self._critics.get(policy),
                scale=self._scales.get(policy),
            )
            if self._magnet is not None:
                batch = replace(batch, magnet=self._magnet.dist_inputs(policy, batch))
            if not self._teacher_weight:
                # The teacher may have acted before: samples are requested ahead.
                batch = replace(batch, taught=None)
            batches[policy] = batch
        return batches

    def compute_loss_for_module(
        self, *, module_id: str, batch: Minibatch, fwd_out: dict[str, Tensor], **_: Any
    ) -> PPOLoss:
        """Return the loss of one policy on some steps."""
        critic = self._critics.get(module_id)
        return ppo_loss(
            batch,
            fwd_out[Columns.ACTION_DIST_INPUTS],
            fwd_out[Columns.VF_PREDS] if critic is None else critic(batch.inputs[Columns.OBS] | batch.central),
            self.module[module_id].distribution,
            clip=self.hyperparameters[module_id].clip,
            entropy=self.hyperparameters[module_id].entropy,
            value_loss=self.settings.value_loss,
            magnet=self._magnet_weight,
            teacher=self._teacher_weight,
        )

    def _lr(self, name: str) -> float:
        """Return the current learning rate of an optimiser."""
        return self._common_lr if name == ALL_MODULES else self.hyperparameters[name.removesuffix(CRITIC)].lr

    def get_state(
        self,
        components: str | Collection[str] | None = None,
        *,
        not_components: str | Collection[str] | None = None,
        **kwargs: Any,
    ) -> dict[str, Any]:
        """Return RLlib's state with the central critics, the units of returns and the magnet's snapshot, if any."""
        state: dict[str, Any] = super().get_state(components, not_components=not_components, **kwargs)
        for key, networks in ((CRITICS, self._critics), (SCALES, self._scales)):
            if networks and includes_component(self, key, components, not_components):
                state[key] = {policy: network.state_dict() for policy, network in networks.items()}
        if isinstance(self._magnet, Previous) and includes_component(self, MAGNET, components, not_components):
            state[MAGNET] = self._magnet.get_state()
        return state

    def set_state(self, state: dict[str, Any]) -> None:
        super().set_state(state)
        for key, networks in ((CRITICS, self._critics), (SCALES, self._scales)):
            # A run without them, which this one continues, has none.
            for policy, weights in state.get(key, {}).items() if networks else ():
                networks[policy].load_state_dict(weights)
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
            names: tuple[str, ...] = STATISTICS
            names += () if batch.magnet is None else (MAGNET_KL,)
            names += () if batch.taught is None else (TEACHER_LOSS,)
            logged = dict(zip(names, means, strict=True))
            logged |= {EXPLAINED_VARIANCE: batch.explained_variance, KL: divergences[policy]}
            scheduled = scheduled_hyperparameters(self.settings, policy)
            logged |= {SCHEDULES[name]: getattr(self.hyperparameters[policy], name) for name in scheduled}
            if self.settings.magnet is not None and not isinstance(self.settings.magnet.weight, float):
                logged[MAGNET_WEIGHT] = self._magnet_weight
            if self.settings.teacher is not None and not isinstance(self.settings.teacher.weight, float):
                logged[TEACHER_WEIGHT] = self._teacher_weight
            self.metrics.log_dict(logged, key=policy, window=1)
            self.metrics.log_value((policy, NUM_MODULE_STEPS_TRAINED), len(batch), reduce="sum")

    @torch.no_grad()
    def _divergences(self, batches: dict[str, TrainBatch]) -> dict[str, float]:
        """Estimate each policy's divergence from the one that sampled the batch, on about KL_STEPS steps."""
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
