"""Does a version act identically in training, in evaluation and over HTTP?

Each shipped configuration is trained briefly, published and promoted. Then the greedy actions of each of its policies
on the same observations are computed three times: by the trainer's module, restored from the checkpoint; by the ONNX
graph, as loaded for evaluation; and by the endpoint of a running server. A near tie is an observation on which the
graph chose the other one of two actions whose logits differ by less than 1e-5, which may depend on the order of
summation. Target: all others are equal.
"""

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from benchmarks.harness import CONFIGS, Quick, Target
from benchmarks.training.learned import local_ray
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.interface import Interface
from league.policies import load
from league.policies.actions import to_environment
from league.policies.onnx import STATE_IN
from league.policies.open_inference import OpenInferencePolicy
from league.policies.policy import Policy
from league.refs import RemoteRef
from league.registry.aliases import ANY
from league.registry.registry import Registry
from league.registry.storage.manifest import TRAINING
from league.registry.storage.rows import VersionRow
from league.settings import Storage
from league.spaces import Space
from serve_app.runtime.launch import running
from training.export.parity import ObservedBatch, collect_observations, count_differences, module_outputs
from training.export.publish import Checkpoint, load_modules, publish
from training.modules.policy_module import PolicyModule
from training.runs.trial import build_algorithm

OBSERVATIONS = 10_000
BODY = 3 << 18
"""Bytes of observations in a request: a number takes about four characters in JSON, and the body size is limited."""
ROWS = 256


@dataclass(frozen=True, slots=True)
class Compared:
    """For one policy: on how many observations its graph and its endpoint choose another action than its module."""

    policy: str
    observations: int
    near_ties: int
    graph_differs: int
    endpoint_differs: int

    @property
    def equal(self) -> bool:
        return self.graph_differs == self.endpoint_differs == 0


def prepare(path: Path, registry: Registry, updates: int, source: str = "parity/1", **training: object) -> VersionRow:
    """Train a configuration for a few updates, publish and promote the result.

    source: a source is published once. training: other settings.
    """
    config = LeagueConfig.load(path).with_training(runners=0, **training)
    league_interface = interface(config)
    registry.leagues.register(config, league_interface)
    algorithm = build_algorithm(config, league_interface, storage=registry.storage)
    with tempfile.TemporaryDirectory() as scratch:
        try:
            for _ in range(updates):
                algorithm.train()
            algorithm.save_to_path(scratch)
        finally:
            algorithm.stop()
        version = publish(
            Checkpoint(Path(scratch), source=source, steps=updates),
            registry=registry,
            config=config,
            interface=league_interface,
            parent=None,
            git_commit=None,
        )
    registry.aliases.set(
        config.league, "champion", version.number, expected=ANY, actor="benchmark", reason="to compare"
    )
    return version


def compare(version: VersionRow, registry: Registry, url: str, observations: int) -> list[Compared]:
    """Compare each policy of a promoted version on this number of its own observations."""
    row = registry.leagues.get(version.league)
    checkpoint = registry.artifacts.path(version.league, version.number) / TRAINING
    modules = load_modules(checkpoint, row.config, row.interface)
    met = situations(row.config, row.interface, modules, observations)
    several = len(modules) > 1
    compared = []
    for policy, module in modules.items():
        graph = load(version.ref, policy, registry)
        model = f"{version.league}.{policy}" if several else version.league
        spaces = row.interface.of_policy(policy)
        with closing(OpenInferencePolicy(RemoteRef(url, model), policy, spaces)) as endpoint:
            compared.append(_compare(policy, spaces.action, module, graph, endpoint, met[policy]))
    return compared


def situations(
    config: LeagueConfig, league_interface: Interface, modules: Mapping[str, PolicyModule], limit: int
) -> dict[str, list[ObservedBatch]]:
    """Policy → batches from play, with exactly `limit` observations in total."""
    observed: dict[str, list[ObservedBatch]] = {policy: [] for policy in modules}
    seed = 0
    while any(sum(map(len, batches)) < limit for batches in observed.values()):
        for policy, batches in collect_observations(config.environment, league_interface, modules, seed).items():
            observed[policy] += batches
        seed += 1
    return {policy: list(_first(batches, limit)) for policy, batches in observed.items()}


def _first(batches: Sequence[ObservedBatch], limit: int) -> Sequence[ObservedBatch]:
    first = []
    for batch in batches:
        rows = slice(0, min(len(batch), limit))
        first.append(
            ObservedBatch(
                *({name: array[rows] for name, array in part.items()} for part in (batch.observations, batch.state))
            )
        )
        limit -= len(first[-1])
        if not limit:
            break
    return first


def _compare(
    policy: str, space: Space, module: PolicyModule, graph: Policy, endpoint: Policy, batches: list[ObservedBatch]
) -> Compared:
    count = ties = graph_differs = endpoint_differs = 0
    for batch in _joined(batches):
        dist_inputs, _ = module_outputs(module, batch)
        expected = to_environment(module.distribution.mode(torch.from_numpy(dist_inputs)).numpy(), space)
        state = {f"{STATE_IN}{i}": value for i, value in enumerate(batch.state.values())} or None
        by_graph, by_endpoint = (player.act(batch.observations, state=state).actions for player in (graph, endpoint))
        wrong, tied = count_differences(by_graph, expected, dist_inputs, space)
        count, graph_differs, ties = count + len(batch), graph_differs + wrong, ties + tied
        endpoint_differs += count_differences(by_endpoint, expected, dist_inputs, space)[0]
    return Compared(policy, count, ties, graph_differs, endpoint_differs)


def _joined(batches: Sequence[ObservedBatch]) -> list[ObservedBatch]:
    """Fewer and larger batches: as many rows as a request may have."""
    observations, states = (
        {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        for parts in ([met.observations for met in batches], [met.state for met in batches])
    )
    size = sum(array[0].nbytes for array in observations.values())
    rows = max(1, min(ROWS, BODY // size))
    whole = ObservedBatch(observations, states)
    return [
        ObservedBatch(
            *({name: array[start : start + rows] for name, array in part.items()} for part in (observations, states))
        )
        for start in range(0, len(whole), rows)
    ]


def main(quick: Quick = False) -> Iterator[Target]:
    """Compare each policy of each configuration."""
    with tempfile.TemporaryDirectory() as home:
        registry = Registry.open(Storage.at(Path(home)))
        with local_ray(cpus=2):
            versions = [prepare(path, registry, updates=2) for path in sorted(CONFIGS.glob("*.yaml"))]
        with running(registry.storage) as url:
            for version in versions:
                for policy in compare(version, registry, url, 500 if quick else OBSERVATIONS):
                    differences = (policy.graph_differs, policy.endpoint_differs)
                    note = f"of {policy.observations:,}, {policy.near_ties:,} near ties"
                    name = f"{version.league}.{policy.policy}: graph, endpoint"
                    yield Target(name, differences, "differ", at_most=0, note=note)
