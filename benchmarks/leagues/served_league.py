"""A league for serving: the interface of connect four, and versions with a 2×256 network with random weights."""

import contextlib
import io
import json
import logging
import tempfile
import warnings
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from torch import Tensor, nn

from benchmarks.harness import CONFIGS
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.interface import AgentInterface
from league.registry.aliases import ANY
from league.registry.registry import Registry
from league.registry.storage.manifest import Manifest, Parity, PolicyManifest
from league.registry.storage.manifest import Tensor as TensorManifest
from league.registry.storage.rows import AliasEvent
from league.settings import Storage
from league.spaces import inputs
from serve_app.runtime.launch import DEPLOY_YAML, running

LEAGUE = "connect_four"
ACTION = f"/v1/policies/{LEAGUE}/action"
HIDDEN = (256, 256)
PLANES = np.random.default_rng(0).integers(0, 2, (6, 7, 2), dtype=np.int8)
BODY = json.dumps({"observation": {"observation": PLANES.tolist(), "action_mask": [1] * 7}}).encode()
"""A request for one action."""


class MaskedMLP(nn.Module):
    """Board and mask, int8 → the greedy legal column, and the masked logits."""

    def __init__(self, observations: int, actions: int, hidden: tuple[int, ...] = HIDDEN) -> None:
        super().__init__()
        sizes = (observations, *hidden)
        layers = [part for size in zip(sizes, hidden, strict=False) for part in (nn.Linear(*size), nn.Tanh())]
        self.network = nn.Sequential(*layers, nn.Linear(hidden[-1], actions))

    def forward(self, observation: Tensor, action_mask: Tensor) -> tuple[Tensor, Tensor]:
        logits = self.network(observation.flatten(1).float())
        masked = torch.where(action_mask.bool(), logits, torch.tensor(-1e9))
        return masked.argmax(1), masked


def publish(home: Path, versions: int, hidden: tuple[int, ...] = HIDDEN) -> Registry:
    """A registry in `home` whose league has this number of versions, the first of them its champion. hidden: units of
    the network.
    """
    return fill(Registry.open(Storage.at(home)), versions, hidden)


@contextlib.contextmanager
def published(versions: int = 1, hidden: tuple[int, ...] = HIDDEN) -> Iterator[Registry]:
    """The registry of `publish` in a temporary directory."""
    with (
        tempfile.TemporaryDirectory() as scratch,
        contextlib.closing(publish(Path(scratch) / "home", versions, hidden)) as registry,
    ):
        yield registry


@contextlib.contextmanager
def served(
    versions: int = 1,
    *,
    hidden: tuple[int, ...] = HIDDEN,
    change: Callable[[dict[str, Any]], object] | None = None,
    **options: Any,
) -> Iterator[tuple[str, Registry]]:
    """A server of the league, and its registry. change: changes the document deploy.yaml. options: of `running`."""
    with published(versions, hidden) as registry:
        deploy = registry.storage.home.with_name("deploy.yaml")
        document = yaml.safe_load(DEPLOY_YAML.read_text())
        if change is not None:
            change(document)
        deploy.write_text(yaml.safe_dump(document))
        with running(registry.storage, deploy=deploy, **options) as url:
            yield url, registry


def promote(registry: Registry, version: int) -> AliasEvent:
    """Make a version the champion."""
    return registry.aliases.set(LEAGUE, "champion", version, expected=ANY, actor="benchmark", reason="a measurement")


def fill(registry: Registry, versions: int, hidden: tuple[int, ...] = HIDDEN) -> Registry:
    """The registry, with the league of `publish`."""
    config = LeagueConfig.load(CONFIGS / "connect_four.yaml")
    registry.leagues.register(config, interface(config))
    for seed in range(versions):
        registry.publisher.publish(LEAGUE, builder(registry, seed, hidden), source=f"random/{seed}")
    promote(registry, 1)
    return registry


def builder(registry: Registry, seed: int, hidden: tuple[int, ...]) -> Callable[[Path, int], Manifest]:
    """A function that writes the files of a version into a directory."""
    row = registry.leagues.get(LEAGUE)
    (policy,) = row.interface.policy_ids
    spaces = row.interface.of_policy(policy)

    def build(directory: Path, number: int) -> Manifest:
        torch.manual_seed(seed)
        _export(MaskedMLP(PLANES.size, 7, hidden).eval(), directory / f"{policy}.onnx")
        return Manifest(
            league=LEAGUE,
            version=number,
            created_at=datetime.now(UTC),
            interface=row.interface,
            policies={policy: _policy(spaces, f"{policy}.onnx")},
            environment=row.config.environment,
            environment_digest=row.environment_digest,
            algorithm="ppo",
            settings={},
            seed=seed,
            steps=0,
            stack={},
        )

    return build


def _policy(spaces: AgentInterface, file: str) -> PolicyManifest:
    return PolicyManifest(
        file=file,
        observation=spaces.observation,
        action=spaces.action,
        inputs=tuple(
            TensorManifest(name=name, dtype=leaf.dtype, shape=(None, *leaf.shape))
            for name, leaf in inputs(spaces.observation).items()
        ),
        outputs=(
            TensorManifest(name="action", dtype="int64", shape=(None,)),
            TensorManifest(name="action_dist_inputs", dtype="float32", shape=(None, 7)),
        ),
        parity=Parity(observations=0, mismatches=0, near_ties=0, max_difference=0.0),
    )


def _export(network: nn.Module, path: Path) -> None:
    batch = torch.export.Dim("batch")
    examples = (torch.zeros((2, *PLANES.shape), dtype=torch.int8), torch.ones((2, 7), dtype=torch.int8))
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            network,
            examples,
            dynamo=True,
            input_names=["observation", "action_mask"],
            output_names=["action", "action_dist_inputs"],
            dynamic_shapes=({0: batch}, {0: batch}),
            verbose=False,
        )
    assert program is not None
    program.save(str(path), external_data=False)
