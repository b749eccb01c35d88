"""Manifests of versions with handwritten graphs."""

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

import onnx
from onnx import ValueInfoProto, helper

from league.interface import AgentInterface
from league.registry.storage.manifest import Manifest, Parity, PolicyManifest, Tensor
from league.registry.storage.rows import LeagueRow


def manifest(row: LeagueRow, number: int, policies: Mapping[str, PolicyManifest], **more: Any) -> Manifest:
    """The manifest of a version of a registered league."""
    fields: dict[str, Any] = {"algorithm": "ppo", "settings": {}, "seed": 0, "steps": number, "stack": {}} | more
    return Manifest(
        league=row.slug,
        version=number,
        created_at=datetime.now(UTC),
        interface=row.interface,
        policies=dict(policies),
        environment=row.config.environment,
        environment_digest=row.environment_digest,
        **fields,
    )


def policy_manifest(spaces: AgentInterface, name: str, graph: bytes, **files: str | None) -> PolicyManifest:
    """The manifest of a graph. files: the names of other files of the policy."""
    model = onnx.load_from_string(graph).graph
    inputs, outputs = (tuple(map(_tensor, values)) for values in (model.input, model.output))
    return PolicyManifest(
        file=f"{name}.onnx",
        observation=spaces.observation,
        action=spaces.action,
        inputs=inputs,
        outputs=outputs,
        state=tuple(tensor for tensor in inputs if tensor.name.startswith("state_in_")),
        parity=Parity(observations=2000, mismatches=0, near_ties=0, max_difference=0.0),
        **files,
    )


def _tensor(value: ValueInfoProto) -> Tensor:
    tensor = value.type.tensor_type
    shape = tuple(dimension.dim_value or None for dimension in tensor.shape.dim)
    return Tensor(name=value.name, dtype=helper.tensor_dtype_to_np_dtype(tensor.elem_type).name, shape=shape)
