"""Do imported models act as they did in the programs that made them?

Two ONNX files of connect four, whose tensors have other names, a checkpoint of RLlib's PPO and a file of
Stable-Baselines3 of simple_spread are imported, evaluated and promoted. Then new
observations from play, half of them at random, are answered by the program that made the model, by the published graph,
and by a running server. Target: no action differs on 10,000 observations; near ties are not excused. Stable-Baselines3
is left out if it is not installed.
"""

import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.harness import CONFIGS, Quick, Target
from benchmarks.peers.foreign_models import (
    ForeignModel,
    mapped_graph,
    matched_graph,
    rllib_checkpoint,
    stable_baselines_file,
)
from benchmarks.training.learned import local_ray
from evaluation.matches.tournament import evaluate
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.policies import load
from league.policies.onnx import OnnxPolicy
from league.policies.open_inference import OpenInferencePolicy
from league.refs import RemoteRef
from league.registry.aliases import ANY
from league.registry.registry import Registry
from league.registry.storage.rows import VersionRow
from league.settings import Storage
from serve_app.runtime.launch import running
from training.importing.checks import collect
from training.importing.open_source import open_sources
from training.importing.publish import publish

OBSERVATIONS = 10_000
ROWS = 256
"""Observations of one request."""
SEED = 1
"""The import itself plays with seed 0."""


@dataclass(frozen=True, slots=True)
class Compared:
    """On how many observations the graph and the endpoint choose another action than the source."""

    name: str
    ref: str
    observations: int
    graph_differs: int
    endpoint_differs: int
    different_actions: int
    """Number of actions that the source chose at least once."""


def prepare(directory: Path) -> list[ForeignModel]:
    """The models, in `directory`."""
    makers: list[Callable[[Path], ForeignModel]] = [mapped_graph, matched_graph, rllib_checkpoint]
    if find_spec("stable_baselines3"):
        makers.append(stable_baselines_file)
    else:
        print("Stable-Baselines3 is not installed: its row is missing (pip install 'policy-league[sb3]')")
    with local_ray(cpus=2):
        return [make(directory) for make in makers]


def compare_all(models: list[ForeignModel], storage: Storage, observations: int) -> list[Compared]:
    """Import, evaluate and promote each model, and compare its actions."""
    registry = Registry.open(storage)
    for name in sorted({model.league for model in models}):
        config = LeagueConfig.load(CONFIGS / f"{name}.yaml")
        registry.leagues.register(config, interface(config))
    versions = [_import(model, registry) for model in models]
    with running(storage, replicas=1) as url:
        return [_compare(*pair, registry, url, observations) for pair in zip(models, versions, strict=True)]


def _import(model: ForeignModel, registry: Registry) -> VersionRow:
    """Publish and evaluate a model, and make it champion."""
    league = registry.leagues.get(model.league)
    sources, digest = open_sources(model.path, league.interface, **model.options)
    version = publish(model.league, sources, digest=digest, registry=registry)
    evaluate(model.league, [version.ref, "script:random"], registry=registry, blocks=4, workers=0)
    registry.aliases.set(model.league, "champion", version.number, expected=ANY, actor="benchmark", reason="to compare")
    return version


def _compare(model: ForeignModel, version: VersionRow, registry: Registry, url: str, observations: int) -> Compared:
    """Compare source, graph and endpoint on batches from play."""
    row = registry.leagues.get(version.league)
    (policy,) = row.interface.policy_ids
    graph: Any = load(version.ref, policy, registry)
    assert isinstance(graph, OnnxPolicy)
    played = collect(row.config.environment, row.interface, {policy: graph}, SEED)[policy]
    together = {
        name: np.concatenate([batch.observations[name] for batch in played])[:observations]
        for name in played[0].observations
    }
    ref = RemoteRef(url, version.league, str(version.number))
    with closing(OpenInferencePolicy(ref, policy, row.interface.of_policy(policy))) as endpoint:
        answers = [_answer(part, model, graph, endpoint) for part in _parts(together)]
    expected, by_graph, by_endpoint = map(np.concatenate, zip(*answers, strict=True))
    return Compared(
        model.name,
        version.ref,
        len(expected),
        int((by_graph != expected).sum()),
        int((by_endpoint != expected).sum()),
        len(np.unique(expected)),
    )


def _answer(
    observations: Mapping[str, NDArray], model: ForeignModel, graph: OnnxPolicy, endpoint: OpenInferencePolicy
) -> tuple[NDArray, NDArray, NDArray]:
    return model.act(observations), graph.act(observations).actions, endpoint.act(observations).actions


def _parts(observations: Mapping[str, NDArray]) -> list[dict[str, NDArray]]:
    count = len(next(iter(observations.values())))
    return [{name: array[at : at + ROWS] for name, array in observations.items()} for at in range(0, count, ROWS)]


def main(quick: Quick = False) -> Iterator[Target]:
    """Compare each model."""
    with tempfile.TemporaryDirectory() as scratch:
        models = prepare(Path(scratch))
        storage = Storage.at(Path(scratch) / "home")
        for model in compare_all(models, storage, 500 if quick else OBSERVATIONS):
            differences = (model.graph_differs, model.endpoint_differs)
            note = f"of {model.observations:,}"
            yield Target(f"{model.name}: graph, endpoint", differences, "differ", at_most=0, note=note)
            # A model that always acts alike would prove nothing.
            yield Target(f"{model.name}: different actions", model.different_actions, at_least=2)
