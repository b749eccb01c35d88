"""Does a version act alike in training, in evaluation and over HTTP?

Every shipped configuration is trained for a moment, published and promoted. Then each of its policies is asked for its
greedy action on the same observations from play three times: the trainer's own module, read back from the checkpoint;
the ONNX graph, as evaluation loads it; and the endpoint of a running server. A near tie is an observation on which the
graph chose the other of two actions whose logits differ by less than 1e-5: another order of summation may swap them.
Target: all others equal.
"""

import argparse
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from benchmarks.learned import local_ray
from league.config import LeagueConfig
from league.environments.building import interface
from league.interface import Interface
from league.policies import load
from league.policies.actions import to_environment
from league.policies.onnx import STATE_IN
from league.policies.policy import Policy
from league.policies.remote import RemotePolicy
from league.registry.aliases import ANY
from league.registry.manifest import TRAINING
from league.registry.registry import Registry
from league.registry.rows import VersionRow
from league.settings import Storage
from league.spaces import Space
from serve_app.launch import running
from training.modules.acting import Acting
from training.parity import Met, answer, differing, gather
from training.publish import Checkpoint, load_modules, publish
from training.trial import build

CONFIGS = Path(__file__).parent.parent / "configs"
OBSERVATIONS = 10_000
BODY = 3 << 18
"""Bytes of observations in a request: a number takes about four characters in JSON, and a body has a limit."""
ROWS = 256


@dataclass(frozen=True, slots=True)
class Compared:
    """Of one policy: on how many observations its graph and its endpoint chose another action than its module."""

    policy: str
    observations: int
    near_ties: int
    graph_differs: int
    endpoint_differs: int

    @property
    def equal(self) -> bool:
        return self.graph_differs == self.endpoint_differs == 0


def prepare(path: Path, registry: Registry, updates: int, source: str = "parity/1", **training: object) -> VersionRow:
    """Train a configuration for a few updates, publish it, and promote what came of it.

    source: what is published once. training: other settings.
    """
    config = LeagueConfig.load(path).with_training(runners=0, **training)
    described = interface(config)
    registry.register(config, described)
    algorithm = build(config, described, storage=registry.storage)
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
            interface=described,
            parent=None,
            git_commit=None,
        )
    registry.set_alias(config.league, "champion", version.number, expected=ANY, actor="benchmark", reason="to compare")
    return version


def compare(version: VersionRow, registry: Registry, url: str, observations: int) -> list[Compared]:
    """Each policy of a promoted version on so many observations of its own."""
    row = registry.league(version.league)
    checkpoint = registry.artifacts.path(version.league, version.number) / TRAINING
    modules = load_modules(checkpoint, row.config, row.interface)
    met = situations(row.config, row.interface, modules, observations)
    several = len(modules) > 1
    compared = []
    for policy, module in modules.items():
        graph = load(version.ref, policy, registry)
        model = f"{version.league}.{policy}" if several else version.league
        with RemotePolicy(url, model, timeout=60) as endpoint:
            space = row.interface.of_policy(policy).action
            compared.append(_compare(policy, space, module, graph, endpoint, met[policy]))
    return compared


def situations(
    config: LeagueConfig, described: Interface, modules: Mapping[str, Acting], wanted: int
) -> dict[str, list[Met]]:
    """Policy → batches from play, of exactly `wanted` observations in all."""
    found: dict[str, list[Met]] = {policy: [] for policy in modules}
    seed = 0
    while any(sum(map(len, batches)) < wanted for batches in found.values()):
        for policy, batches in gather(config.environment, described, modules, seed).items():
            found[policy] += batches
        seed += 1
    return {policy: list(_first(batches, wanted)) for policy, batches in found.items()}


def _first(batches: Sequence[Met], wanted: int) -> Sequence[Met]:
    chosen = []
    for met in batches:
        rows = slice(0, min(len(met), wanted))
        chosen.append(
            Met(*({name: array[rows] for name, array in part.items()} for part in (met.observations, met.state)))
        )
        wanted -= len(chosen[-1])
        if not wanted:
            break
    return chosen


def _compare(
    policy: str, space: Space, module: Acting, graph: Policy, endpoint: Policy, batches: list[Met]
) -> Compared:
    count = ties = graph_differs = endpoint_differs = 0
    for met in _joined(batches):
        dist_inputs, _ = answer(module, met)
        expected = to_environment(module.distribution.mode(torch.from_numpy(dist_inputs)).numpy(), space)
        state = {f"{STATE_IN}{i}": value for i, value in enumerate(met.state.values())} or None
        by_graph, by_endpoint = (each.act(met.observations, state=state).actions for each in (graph, endpoint))
        wrong, tied = differing(by_graph, expected, dist_inputs, space)
        count, graph_differs, ties = count + len(met), graph_differs + wrong, ties + tied
        endpoint_differs += differing(by_endpoint, expected, dist_inputs, space)[0]
    return Compared(policy, count, ties, graph_differs, endpoint_differs)


def _joined(batches: Sequence[Met]) -> list[Met]:
    """Fewer and larger: as many rows as a request may have."""
    observations, states = (
        {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        for parts in ([met.observations for met in batches], [met.state for met in batches])
    )
    size = sum(array[0].nbytes for array in observations.values())
    rows = max(1, min(ROWS, BODY // size))
    whole = Met(observations, states)
    return [
        Met(*({name: array[start : start + rows] for name, array in part.items()} for part in (observations, states)))
        for start in range(0, len(whole), rows)
    ]


def main() -> int:
    """Print every policy of every configuration; 1 if one acts differently."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="500 observations of each policy")
    observations = 500 if parser.parse_args().quick else OBSERVATIONS
    with tempfile.TemporaryDirectory() as home:
        registry = Registry.open(Storage.at(Path(home)))
        with local_ray(cpus=2):
            versions = [prepare(path, registry, updates=2) for path in sorted(CONFIGS.glob("*.yaml"))]
        print(f"{'policy':>26} {'observations':>13} {'near ties':>10} {'graph differs':>14} {'endpoint differs':>17}")
        with running(registry.storage) as url:
            equal = [_told(version, compare(version, registry, url, observations)) for version in versions]
    print(f"module, graph and endpoint act alike: {'met' if all(equal) else 'MISSED'}")
    return int(not all(equal))


def _told(version: VersionRow, compared: Sequence[Compared]) -> bool:
    for each in compared:
        print(
            f"{version.league + '.' + each.policy:>26} {each.observations:>13,} {each.near_ties:>10,}"
            f" {each.graph_differs:>14,} {each.endpoint_differs:>17,}",
            flush=True,
        )
    return all(each.equal for each in compared)


if __name__ == "__main__":
    sys.exit(main())
