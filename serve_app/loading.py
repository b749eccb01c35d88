"""From a version's number to something that answers: verify every file, load the graphs, warm them up."""

import time
from dataclasses import dataclass

import numpy as np

from league.errors import ArtifactCorrupt, InvalidInput, UnknownPolicy, VersionRetired
from league.policies.onnx import OnnxPolicy
from league.policies.policy import Policy
from league.registry.manifest import PolicyManifest
from league.registry.registry import Registry
from league.spaces import Box, Leaf
from serve_app.observations import ObservationReader

WARM_BATCH = 64
"""Large enough that the time of a row shows, small enough to be done in milliseconds."""


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class LoadedPolicy:
    """One policy, ready to answer."""

    policy: OnnxPolicy
    manifest: PolicyManifest
    reader: ObservationReader
    state: tuple[tuple[str, Leaf], ...]
    """Recurrent inputs; empty for a policy without."""
    inline_rows: int
    """The largest batch whose inference is short enough for the event loop."""


@dataclass(frozen=True, slots=True)
class LoadedVersion:
    """A version of a league, verified, loaded and warm."""

    league: str
    number: int
    sha256: str
    """Digest of the version's manifest.json, which holds the digests of all its files."""
    policies: dict[str, LoadedPolicy]

    def policy(self, name: str | None) -> LoadedPolicy:
        """One policy; None where there is only one. Raises UnknownPolicy, which lists them."""
        if name is None and len(self.policies) == 1:
            return next(iter(self.policies.values()))
        if name not in self.policies:
            asked = f"has no policy {name!r}" if name else f"has several policies: ask for {self.league}.POLICY"
            raise UnknownPolicy(f"{self.league}@{self.number} {asked}; known: {', '.join(self.policies)}")
        return self.policies[name]

    def model(self, policy: LoadedPolicy) -> str:
        """`{league}.{policy}`, the name of one of its policies."""
        return f"{self.league}.{next(name for name, one in self.policies.items() if one is policy)}"


def load(registry: Registry, league: str, number: int, inline: float) -> LoadedVersion:
    """Load a version. Blocks; `inline` is the time in seconds that inference may take on the event loop.

    Raises UnknownLeague, UnknownVersion, VersionRetired, ArtifactCorrupt or StorageError.
    """
    version = registry.version(league, number)
    if registry.artifacts.is_purged(league, number):
        raise VersionRetired(
            f"{version.ref} was retired: its files were removed, and a new episode needs another version"
        )
    registry.artifacts.verify(league, number, version.sha256)
    policies = {}
    for name, manifest in version.manifest.policies.items():
        # Read again, verified as it is read: the file may have changed since.
        graph = registry.artifacts.read(version.manifest, manifest.file)
        try:
            policies[name] = _warm(OnnxPolicy(graph, manifest), manifest, inline)
        except InvalidInput as error:
            raise ArtifactCorrupt(f"policy {name} of {version.ref} does not run: {error}") from error
    return LoadedVersion(league, number, version.sha256, policies)


def _warm(policy: OnnxPolicy, manifest: PolicyManifest, inline: float) -> LoadedPolicy:
    """Run the graph, which allocates what it needs, and see how many rows fit into `inline` seconds."""
    reader = ObservationReader(manifest.observation)
    one, many = (_seconds(policy, reader, rows) for rows in (1, WARM_BATCH))
    per_row = max(many - one, 1e-9) / (WARM_BATCH - 1)
    rows = 0 if one > inline else 1 + int((inline - one) / per_row)
    state = tuple(
        (tensor.name, Box(dtype=tensor.dtype, shape=_sizes(tensor.shape[1:]), low=None, high=None))
        for tensor in manifest.state
    )
    return LoadedPolicy(policy, manifest, reader, state, rows)


def _seconds(policy: Policy, reader: ObservationReader, rows: int) -> float:
    """The fastest of a few runs, for the others shared the processor."""
    observations = reader.zeros(rows)
    taken = []
    for _ in range(4):
        start = time.perf_counter()
        policy.act(observations)
        taken.append(time.perf_counter() - start)
    return float(np.min(taken))


def _sizes(shape: tuple[int | None, ...]) -> tuple[int, ...]:
    assert None not in shape, "only the batch is dynamic"
    return tuple(size for size in shape if size is not None)
