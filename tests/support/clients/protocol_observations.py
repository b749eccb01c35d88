"""Random observations of any league, from the inputs of its policy."""

import numpy as np
from numpy.typing import NDArray

from league.policies.onnx import OnnxPolicy
from league.registry.registry import Registry
from league.settings import Storage
from league.spaces import ACTION_MASK, Box, Discrete
from serve_app.live_versions.policies import Port, Ports, input_ports


def policy_of(storage: Storage, model: str, version: int = 1) -> tuple[OnnxPolicy, Ports]:
    """The policy that answers for a model, and its inputs."""
    league, _, name = model.partition(".")
    registry = Registry.open(storage)
    manifest = registry.versions.get(league, version).manifest
    policy = manifest.policies[name or next(iter(manifest.policies))]
    loaded = OnnxPolicy(registry.artifacts.read(manifest, policy.file), policy)
    registry.close()
    return loaded, input_ports(policy)


def observations(ports: Ports, rows: int, seed: int = 0) -> dict[str, NDArray]:
    """A batch without recurrent state."""
    random = np.random.default_rng(seed)
    return {name: _draw(port, rows, random) for name, port in ports.items() if not port.is_state}


def _draw(port: Port, rows: int, random: np.random.Generator) -> NDArray:
    leaf = port.leaf
    shape, dtype = (rows, *leaf.shape), np.dtype(leaf.dtype)
    if isinstance(leaf, Discrete):
        return random.integers(leaf.start, leaf.start + leaf.n, shape, dtype)
    if port.name == ACTION_MASK:
        mask = random.integers(0, 2, shape, dtype)
        mask[..., 3] = 1
        return mask
    assert isinstance(leaf, Box)
    if dtype.kind == "f":
        return random.normal(size=shape).astype(dtype)
    return random.integers(0, 2 if dtype.kind == "b" or leaf.high == 1 else 100, shape).astype(dtype)
