"""Episode chunks → train batch, a column at a time.

RLlib's default learner pipeline handles each time step as a Python object. Here the chunks of a policy are
concatenated, their observations, T + 1 per chunk of T steps, are valued in one pass, and the last of each chunk serves
as bootstrap: 0 where the agent terminated, its value where the agent was truncated or the chunk was cut.
"""

from collections import defaultdict
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from ray.rllib.connectors.connector_v2 import ConnectorV2
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModule
from ray.rllib.core.rl_module.rl_module import RLModule
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.evaluation.postprocessing import Postprocessing

from training.learners.advantages import generalized_advantages

COLUMNS = (Columns.ACTION_LOGP, Columns.ACTION_DIST_INPUTS)


class TrainBatch(ConnectorV2):
    """The whole learner pipeline of an actor-critic algorithm."""

    def __init__(
        self,
        input_observation_space: Any = None,
        input_action_space: Any = None,
        *,
        gamma: float = 0.99,
        lambda_: float = 0.95,
    ) -> None:
        super().__init__(input_observation_space, input_action_space)
        self.gamma = gamma
        self.lambda_ = lambda_

    def __call__(
        self, *, rl_module: MultiRLModule, episodes: list[SingleAgentEpisode], **_: Any
    ) -> dict[str, dict[str, Any]]:
        """Policy id → its columns as tensors on the module's device."""
        by_policy = defaultdict(list)
        for episode in episodes:
            if len(episode):
                by_policy[episode.module_id].append(episode)
        return {policy: self._batch(rl_module[policy], chunks) for policy, chunks in by_policy.items()}

    def _batch(self, module: RLModule, chunks: list[SingleAgentEpisode]) -> dict[str, Any]:
        device = next(module.parameters()).device
        observations = {
            name: torch.from_numpy(np.concatenate([chunk.observations.data[name] for chunk in chunks])).to(device)
            for name in chunks[0].observations.data
        }
        with torch.no_grad():
            values = module.compute_values({Columns.OBS: observations}).cpu().numpy()
        lengths = np.array([len(chunk) for chunk in chunks])
        ends = np.cumsum(lengths + 1) - 1
        acted = np.ones(len(values), dtype=bool)
        acted[ends] = False
        values[ends[[chunk.is_terminated for chunk in chunks]]] = 0.0
        lasts = np.zeros(lengths.sum(), dtype=bool)
        lasts[np.cumsum(lengths) - 1] = True
        advantages = generalized_advantages(
            np.concatenate([chunk.rewards.data for chunk in chunks]),
            values[acted],
            values[1:][acted[:-1]],
            lasts,
            self.gamma,
            self.lambda_,
        )
        kept = torch.from_numpy(acted).to(device)
        batch = {
            column: np.concatenate([chunk.extra_model_outputs[column].data for chunk in chunks]) for column in COLUMNS
        }
        batch[Columns.ACTIONS] = np.concatenate([chunk.actions.data for chunk in chunks])
        batch[Postprocessing.VALUE_TARGETS] = (advantages + values[acted]).astype(np.float32)
        batch[Postprocessing.ADVANTAGES] = _standardized(advantages).astype(np.float32)
        tensors = {column: torch.from_numpy(array).to(device) for column, array in batch.items()}
        return tensors | {Columns.OBS: {name: tensor[kept] for name, tensor in observations.items()}}


def train_batch_connector(gamma: float, lambda_: float) -> Callable[..., TrainBatch]:
    """What AlgorithmConfig.training(learner_connector=…) takes."""
    return lambda observation_space, action_space: TrainBatch(
        observation_space, action_space, gamma=gamma, lambda_=lambda_
    )


def _standardized(values: np.ndarray) -> np.ndarray:
    return (values - values.mean()) / max(1e-4, values.std())
