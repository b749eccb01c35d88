"""The magnet of PPO: a reference policy ρ that the loss pulls the policy π towards, by KL(π ‖ ρ).

In two-player zero-sum games, a policy that is regularised this way converges, instead of cycling around the
equilibrium: magnetic mirror descent (Sokota et al., 2023, arXiv 2206.05825). If ρ is refreshed with the policy itself,
as in regularised Nash dynamics (Perolat et al., 2022, arXiv 2206.15378), its fixed points are equilibria of the game.
"""

import copy
from collections.abc import Mapping
from contextlib import closing
from typing import Any

import numpy as np
import torch
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModule
from torch import Tensor

from league.config.ppo import PREVIOUS, UNIFORM, MagnetConfig
from league.errors import ConfigError
from league.interface import Interface
from league.policies.loading import contestant
from league.policies.onnx import OnnxPolicy
from league.refs import CheckpointRef
from league.registry.registry import Registry
from league.settings import Storage
from league.spaces import Box
from training.learners.train_batch import TrainBatch
from training.modules.policy_module import MASKED_LOGIT
from training.sampling.episode_chunks import PASS_ROWS

State = dict[str, dict[str, Any]]
"""Policy id → weights."""


def states(module: MultiRLModule) -> State:
    """Return the weights of all policies."""
    return {policy: policy_module.get_state() for policy, policy_module in module.items()}


class Uniform:
    """The uniform distribution over legal actions."""

    def dist_inputs(self, policy: str, batch: TrainBatch) -> Tensor:  # noqa: ARG002
        """Return the inputs of ρ's action distribution at the steps of a batch, (n, d)."""
        return torch.where(batch.dist_inputs > MASKED_LOGIT / 2, 0.0, MASKED_LOGIT)


class Previous:
    """A snapshot of the policies themselves, refreshed at every `every`-th update."""

    def __init__(self, module: MultiRLModule, every: int) -> None:
        self._every = every
        self._snapshot = copy.deepcopy(module)

    def before_update(self, number: int, module: MultiRLModule) -> None:
        """Refresh the snapshot if it is due. number: of updates before this one."""
        if number % self._every == 0:
            self.set_state(states(module))

    @torch.no_grad()
    def dist_inputs(self, policy: str, batch: TrainBatch) -> Tensor:
        """Return the inputs of ρ's action distribution at the steps of a batch, (n, d)."""
        parts = [
            self._snapshot[policy].greedy_outputs(
                {Columns.OBS: {name: value[rows] for name, value in batch.observations.items()}}
            )[Columns.ACTION_DIST_INPUTS]
            for rows in batch.acted.split(PASS_ROWS)
        ]
        return torch.cat(parts)

    def get_state(self) -> State:
        """Return the snapshot."""
        return states(self._snapshot)

    def set_state(self, state: State) -> None:
        """Load what `get_state` returned."""
        for policy, policy_module in self._snapshot.items():
            policy_module.set_state(state[policy])


class Version:
    """A published version."""

    def __init__(self, policies: Mapping[str, OnnxPolicy]) -> None:
        self._policies = policies

    def dist_inputs(self, policy: str, batch: TrainBatch) -> Tensor:
        """Return the inputs of ρ's action distribution at the steps of a batch, (n, d)."""
        parts = []
        for rows in batch.acted.split(PASS_ROWS):
            observations = {name: value[rows].cpu().numpy() for name, value in batch.observations.items()}
            dist_inputs = self._policies[policy].distribution(observations).dist_inputs
            assert dist_inputs is not None
            parts.append(dist_inputs)
        return torch.from_numpy(np.concatenate(parts)).to(batch.dist_inputs.device)


Magnet = Uniform | Previous | Version


def magnet(settings: MagnetConfig, module: MultiRLModule, interface: Interface, storage: Storage | None) -> Magnet:
    """Return the reference policy. Raises ConfigError for an unsuitable version, LeagueError if it cannot be loaded."""
    if settings.ref == UNIFORM:
        return Uniform()
    if settings.ref == PREVIOUS:
        assert settings.every is not None
        return Previous(module, settings.every)
    if storage is None:
        raise ConfigError(f"training.magnet.ref: {settings.ref} is a version, but no storage is given to load it from")
    with closing(Registry.open(storage)) as registry:
        return Version(_graphs(settings.ref, registry, interface))


def check_magnet(settings: MagnetConfig, interface: Interface) -> None:
    """Raise ConfigError if a policy's actions do not support the magnet."""
    for policy in interface.policy_ids:
        if settings.ref == UNIFORM and isinstance(interface.of_policy(policy).action, Box):
            raise ConfigError(
                f"training.magnet.ref: uniform needs discrete actions, but those of {policy} are continuous"
            )


def _graphs(ref: str, registry: Registry, interface: Interface) -> dict[str, OnnxPolicy]:
    manifest = registry.versions.resolve(CheckpointRef.parse(ref)).manifest
    if not manifest.has_distribution:
        raise ConfigError(
            f"training.magnet.ref: {ref} ({manifest.algorithm}) has no action distribution, which a magnet needs"
        )
    graphs = {}
    for policy, graph in contestant(ref, registry, interface).values():
        assert isinstance(graph, OnnxPolicy)
        if graph.initial_state(1):
            raise ConfigError(f"training.magnet.ref: {ref} is recurrent, which a magnet does not support")
        graphs[policy] = graph
    return graphs
