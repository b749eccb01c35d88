"""A league for evaluation: the bundled connect_four, and untrained versions with its network and different seeds."""

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import torch

from league.config.league import LeagueConfig
from league.environments.building import interface
from league.registry.registry import Registry
from league.registry.storage.manifest import Manifest, Parity, PolicyManifest
from league.registry.storage.rows import LeagueRow
from league.settings import Storage
from training.algorithms.rllib_config import module_spec
from training.export.onnx_export import export_policy, graph_tensors
from training.modules.actor_critic import ActorCritic

CONFIG = LeagueConfig.load(Path(__file__).parents[2] / "policy_league/configs" / "connect_four.yaml")


def with_mlp(config: LeagueConfig) -> LeagueConfig:
    """The same league with an MLP of 2×256 instead of the convolutional network."""
    training = config.training.model_copy(update={"convolutions": (), "hidden": (256, 256)})
    return config.model_copy(update={"training": training})


def publish(home: Path, versions: int, config: LeagueConfig | None = None) -> tuple[Registry, list[ActorCritic]]:
    """A registry in `home` with this number of versions, and the modules that they were exported from."""
    config = config or CONFIG
    registry = Registry.open(Storage.at(home))
    registry.leagues.register(config, interface(config))
    row = registry.leagues.get(config.league)
    modules = [_module(row, seed) for seed in range(versions)]
    for seed, module in enumerate(modules):
        registry.publisher.publish(config.league, _builder(row, module, seed), source=f"untrained/{seed}", parent=None)
    return registry, modules


def _module(row: LeagueRow, seed: int) -> ActorCritic:
    torch.manual_seed(seed)
    (policy,) = row.interface.policy_ids
    module: ActorCritic = module_spec(row.config.training, row.interface).build()[policy]
    return module.eval()


def _builder(row: LeagueRow, module: ActorCritic, seed: int) -> Callable[[Path, int], Manifest]:
    (policy,) = row.interface.policy_ids
    spaces = row.interface.of_policy(policy)

    def build(directory: Path, number: int) -> Manifest:
        export_policy(module, spaces, directory / f"{policy}.onnx")
        inputs, outputs, state = graph_tensors(module, spaces)
        return Manifest(
            league=row.slug,
            version=number,
            created_at=datetime.now(UTC),
            interface=row.interface,
            policies={
                policy: PolicyManifest(
                    file=f"{policy}.onnx",
                    observation=spaces.observation,
                    action=spaces.action,
                    inputs=inputs,
                    outputs=outputs,
                    state=state,
                    parity=Parity(observations=0, mismatches=0, near_ties=0, max_difference=0.0),
                )
            },
            environment=row.config.environment,
            environment_digest=row.environment_digest,
            algorithm="ppo",
            settings={},
            seed=seed,
            steps=0,
            stack={},
        )

    return build
