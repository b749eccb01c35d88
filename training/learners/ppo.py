"""PPO's learner."""

import logging
from collections.abc import Iterable
from typing import Any

import torch
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.algorithms.ppo.torch.ppo_torch_learner import PPOTorchLearner
from ray.rllib.core.learner.training_data import TrainingData
from ray.rllib.utils.typing import ParamDict

from training.learners.minibatches import Minibatches

logger = logging.getLogger(__name__)

GRADIENT_NORM = "gradient_norm"


class PPOLearner(PPOTorchLearner):
    """RLlib's PPO loss on our train batch and minibatches, with Adam's fused kernel.

    Small networks on a CPU spend more on per-parameter bookkeeping than on arithmetic: the global norm of a policy's
    gradients is computed once, clips them, and tells whether they are finite.
    """

    def configure_optimizers_for_module(self, module_id: str, config: AlgorithmConfig | None = None) -> None:
        assert config is not None
        params = self.get_parameters(self._module[module_id])
        # eps as in the reference implementation of PPO (openai/baselines).
        optimizer = torch.optim.Adam(
            params, lr=config.lr if isinstance(config.lr, float) else 1.0, eps=1e-5, fused=True
        )
        self.register_optimizer(module_id=module_id, optimizer=optimizer, params=params, lr_or_lr_schedule=config.lr)

    def postprocess_gradients(self, gradients_dict: ParamDict) -> ParamDict:
        """Clip each policy's gradients by their global norm. Those of a policy whose norm is not finite are dropped."""
        for module_id, module in self.module.items():
            params = [param for param in module.parameters() if param.grad is not None]
            norm = torch.nn.utils.clip_grad_norm_(params, self.config.grad_clip)
            self.metrics.log_value((module_id, GRADIENT_NORM), norm, window=1)
            if not torch.isfinite(norm):
                logger.warning("Dropped a gradient of policy %s that is not finite.", module_id)
                for param in params:
                    param.grad = None
        return gradients_dict

    def apply_gradients(self, _: ParamDict) -> None:
        """Step the optimisers; parameters without a gradient stay."""
        for optimizer in self._named_optimizers.values():
            optimizer.step()

    def _create_iterator_if_necessary(
        self, *, training_data: TrainingData, num_epochs: int = 1, minibatch_size: int | None = None, **_: Any
    ) -> Iterable[Any]:
        batch = self._make_batch_if_necessary(training_data=training_data)
        return Minibatches(batch, minibatch_size=minibatch_size or batch.count, num_epochs=num_epochs)
