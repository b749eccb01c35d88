"""Publishes imported models as a version: graphs, probes and a manifest that records their origin."""

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from league.config.environment import EnvironmentConfig
from league.errors import UnknownPolicy
from league.interface import Interface
from league.policies.onnx import OnnxPolicy
from league.registry.registry import Registry
from league.registry.storage.manifest import PROBES, Manifest, PolicyManifest
from league.registry.storage.rows import VersionRow
from league.stack import installed
from training.export.parity import check_rows, probes
from training.importing import checks
from training.importing.adapted_graph import adapt, graph_tensors
from training.importing.source import Source

ALGORITHM = "imported"
"""In the manifest, instead of the algorithm that trained the version."""


def publish(
    league: str, sources: Mapping[str, Source], *, digest: str, registry: Registry, seed: int = 0
) -> VersionRow:
    """Adapt, check and publish `sources` as the next version of a league.

    Args:
        league: The league, which must be registered.
        sources: Policy id → model.
        digest: Identifies the content of the source: the same content is published once.
        registry: The registry.
        seed: Seed of the play that yields the observations of the checks.

    Raises:
        LeagueArchived: The league is archived.
        UnknownPolicy: A policy of the league has no source.
        EnvironmentMismatch: A source does not fit the league.
        ParityError: A check failed. No version exists then.
    """
    row = registry.leagues.get(league)
    row.require_active()
    interface = row.interface
    if missing := [policy for policy in interface.policy_ids if policy not in sources]:
        raise UnknownPolicy(f"there is no model for policy {missing[0]} of {league}")

    def build(staging: Path, number: int) -> Manifest:
        return Manifest(
            league=league,
            version=number,
            created_at=datetime.now(UTC),
            interface=interface,
            policies=_write(staging, row.config.environment, interface, sources, seed),
            environment=row.config.environment,
            environment_digest=row.config.environment.digest(),
            algorithm=ALGORITHM,
            settings={
                "origin": {policy: source.origin for policy, source in sources.items()},
                "greedy": any(source.mapping.kind in ("values", "action") for source in sources.values()),
            },
            seed=seed,
            steps=0,
            stack=installed(),
        )

    return registry.publisher.publish(league, build, source=f"import/{digest}")


def _write(
    staging: Path, environment: EnvironmentConfig, interface: Interface, sources: Mapping[str, Source], seed: int
) -> dict[str, PolicyManifest]:
    """Write and check the graphs and probes of all policies."""
    graphs: dict[str, OnnxPolicy] = {}
    partial: dict[str, dict[str, Any]] = {}
    for policy in interface.policy_ids:
        source, spaces = sources[policy], interface.of_policy(policy)
        file = staging / f"{policy}.onnx"
        file.write_bytes(adapt(source.model, source.mapping, spaces, policy))
        input_tensors, output_tensors, state = graph_tensors(source.model, source.mapping, spaces)
        partial[policy] = {
            "file": file.name, "observation": spaces.observation, "action": spaces.action,
            "inputs": input_tensors, "outputs": output_tensors, "state": state, "probes": f"{policy}{PROBES}",
        }  # fmt: skip
        graphs[policy] = OnnxPolicy(file)
    played = checks.collect(environment, interface, graphs, seed)
    policies = {}
    for policy, graph in graphs.items():
        spaces = interface.of_policy(policy)
        check_rows(policy, graph, played[policy], spaces.action)
        parity = checks.check_parity(policy, graph, sources[policy], played[policy], spaces)
        (staging / partial[policy]["probes"]).write_bytes(probes(graph, played[policy]).to_bytes())
        policies[policy] = PolicyManifest(**partial[policy], parity=parity)
    return policies
