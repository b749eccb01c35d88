"""Policies: ONNX graphs, scripted baselines and remote policies."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from league.policies.policy import Policy
    from league.registry.registry import Registry


def load(ref: str, policy: str | None = None, registry: "Registry | None" = None) -> "Policy":
    """Load a policy by reference; see `league.policies.loading.load`."""
    from league.policies import loading

    return loading.load(ref, policy, registry)
