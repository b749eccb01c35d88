"""PPO's learner: one update of those policies that learn now, from the episodes of one sample."""

import logging
from collections import defaultdict
from collections.abc import Collection, Iterable
from typing import Any

import torch
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.core.columns import Columns
from ray.rllib.core.learner.learner import DEFAULT_OPTIMIZER
from ray.rllib.core.learner.torch.torch_learner import TorchLearner
from ray.rllib.core.learner.training_data import TrainingData
from ray.rllib.core.rl_module.apis.value_function_api import ValueFunctionAPI
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.utils.metrics import ALL_MODULES, NUM_MODULE_STEPS_TRAINED
from torch import Tensor

from league.config import LeagueConfig
from league.errors import ConfigError
from league.training_config import PPOConfig
from training.learners.hyperparameters import hyperparameters
from training.learners.minibatches import minibatches
from training.learners.ppo_loss import PPOLoss, ppo_loss
from training.learners.train_batch import Bootstraps, Minibatch, TrainBatch, train_batch, unless_terminated
from training.modules.shared_encoder import SharedEncoder
from training.sampling.env_runner import LEAGUE

logger = logging.getLogger(__name__)

STATISTICS = ("policy_loss", "vf_loss", "entropy", "clip_fraction", "gradient_norm")
"""Logged per policy: means over the minibatches of an update."""
EXPLAINED_VARIANCE = "vf_explained_var"
KL = "kl"
"""Mean Kullback–Leibler divergence of the policy after an update from that before."""
KL_STEPS = 1024
"""Steps that the divergence is estimated on."""
ENCODER = "encoder"
ADAM_EPSILON = 1e-5
"""As in the reference implementation of PPO (openai/baselines)."""


class PPOLearner(TorchLearner):
    """Works on whole columns: RLlib's loop handles each minibatch in several layers of dictionaries, counters and logs,
    which for networks of a few hundred units costs more than the arithmetic.

    A policy without steps in the episodes, or that does not learn now, keeps weights and optimiser as they are.
    """

    bootstraps: Bootstraps = staticmethod(unless_terminated)
    """Which chunks end on an observation whose value counts."""

    def build(self) -> None:
        """Raises ConfigError where a GPU is asked for and there is none."""
        if self.config.num_gpus_per_learner and not torch.cuda.is_available():
            raise ConfigError(
                f"training.gpus: {self.config.num_gpus_per_learner:g} asked for the learner, but torch sees no GPU here"
            )
        settings = LeagueConfig.model_validate(self.config.env_config[LEAGUE]).training
        assert isinstance(settings, PPOConfig)
        self.settings = settings
        self.hyperparameters = hyperparameters(self.settings, tuple(self.config.policies))
        super().build()

    @classmethod
    def rl_module_required_apis(cls) -> list[type]:
        return [ValueFunctionAPI]

    def configure_optimizers(self) -> None:
        """Adam for each policy's own parameters, and one for a shared encoder's."""
        shared = self.module.encoder if isinstance(self.module, SharedEncoder) else None
        common = list(shared.parameters()) if shared is not None else []
        self._parameters: dict[str, list[torch.nn.Parameter]] = {}
        for policy, module in self.module.items():
            own = [parameter for parameter in module.parameters() if not any(parameter is other for other in common)]
            self._add_optimizer(policy, own, self.hyperparameters[policy].lr)
        if common:
            self._add_optimizer(ALL_MODULES, common, self.settings.lr)

    def configure_optimizers_for_module(self, module_id: str, config: AlgorithmConfig | None = None) -> None:
        """Only RLlib's `add_module` would call it: optimisers are made all at once, as modules may share an encoder."""
        raise NotImplementedError(f"the policies of a league are fixed: {module_id} cannot be added")

    def update(
        self,
        *,
        training_data: TrainingData,
        policies: Collection[str] | None = None,
        num_epochs: int = 1,
        minibatch_size: int | None = None,
        **_: Any,
    ) -> dict[str, Any]:
        """Learn from the episodes of a sample. policies: those that learn, by default all.

        Returns policy id → metrics, for the policies that have learned.
        """
        self._weights_seq_no += 1
        batches = self._batches(training_data.episodes, self.module.keys() if policies is None else policies)
        if batches:
            size = minibatch_size or max(len(batch) for batch in batches.values())
            statistics: dict[str, list[Tensor]] = defaultdict(list)
            for minibatch in minibatches(batches, size=size, epochs=num_epochs):
                for policy, row in self._descend(minibatch).items():
                    statistics[policy].append(row)
            self._log(batches, statistics)
        metrics = self.metrics.reduce()
        # What was once logged stays in the logger's answer, as NaN.
        return {policy: metrics[policy] for policy in batches}

    def _batches(self, episodes: Iterable[SingleAgentEpisode], policies: Collection[str]) -> dict[str, TrainBatch]:
        chunks = defaultdict(list)
        for episode in episodes:
            if len(episode) and episode.module_id in policies:
                chunks[episode.module_id].append(episode)
        recurrence = self.settings.recurrence
        return {
            policy: train_batch(
                module,
                chunks[policy],
                gamma=self.hyperparameters[policy].gamma,
                lambda_=self.hyperparameters[policy].lambda_,
                sequence=recurrence.sequence if recurrence else None,
                bootstraps=self.bootstraps,
            )
            for policy, module in self.module.items()
            if policy in chunks
        }

    def _descend(self, minibatch: dict[str, Minibatch]) -> dict[str, Tensor]:
        """One step of gradient descent on the sum of the policies' losses; policy id → STATISTICS."""
        for parameters in self._parameters.values():
            for parameter in parameters:
                parameter.grad = None
        answers = self.module.forward_train({policy: steps.inputs for policy, steps in minibatch.items()})
        losses = {
            policy: self.compute_loss_for_module(module_id=policy, batch=steps, fwd_out=answers[policy])
            for policy, steps in minibatch.items()
        }
        torch.autograd.backward([loss.total for loss in losses.values()])
        norms = {name: self._apply(name) for name in self._parameters if name in minibatch or name == ALL_MODULES}
        return {policy: torch.stack([*loss[1:], norms[policy]]).detach() for policy, loss in losses.items()}

    def compute_loss_for_module(
        self, *, module_id: str, batch: Minibatch, fwd_out: dict[str, Tensor], **_: Any
    ) -> PPOLoss:
        """The loss of one policy on some steps, from what its module answers to them."""
        return ppo_loss(
            batch,
            fwd_out[Columns.ACTION_DIST_INPUTS],
            fwd_out[Columns.VF_PREDS],
            self.module[module_id].distribution,
            clip=self.hyperparameters[module_id].clip,
            entropy=self.hyperparameters[module_id].entropy,
            value_loss=self.settings.value_loss,
        )

    def _apply(self, name: str) -> Tensor:
        """Clip the gradients of one optimiser by their global norm, and take its step unless they are not finite."""
        norm = torch.nn.utils.clip_grad_norm_(self._parameters[name], self.settings.grad_clip)
        if torch.isfinite(norm):
            self._named_optimizers[f"{name}_{DEFAULT_OPTIMIZER}"].step()
        else:
            logger.warning("Dropped a gradient of %s that is not finite.", name)
        return norm

    def _add_optimizer(self, name: str, parameters: list[torch.nn.Parameter], lr: float) -> None:
        optimizer = torch.optim.Adam(parameters, lr=lr, eps=ADAM_EPSILON, fused=True)
        self.register_optimizer(module_id=name, optimizer=optimizer, params=parameters)
        self._parameters[name] = parameters

    def _log(self, batches: dict[str, TrainBatch], statistics: dict[str, list[Tensor]]) -> None:
        divergences = self._divergences(batches)
        for policy, batch in batches.items():
            means = torch.stack(statistics[policy]).mean(0).tolist()
            logged = dict(zip(STATISTICS, means, strict=True))
            logged |= {EXPLAINED_VARIANCE: batch.explained_variance, KL: divergences[policy]}
            self.metrics.log_dict(logged, key=policy, window=1)
            self.metrics.log_value((policy, NUM_MODULE_STEPS_TRAINED), len(batch), reduce="sum")

    def _log_trainable_parameters(self) -> None:
        """RLlib logs the numbers once, and NaN at every later update, also for policies that rest."""

    @torch.no_grad()
    def _divergences(self, batches: dict[str, TrainBatch]) -> dict[str, float]:
        """From the distributions that the steps were drawn by to those of now; on about KL_STEPS of each policy."""
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
