"""What acts: ONNX graphs, scripts, and clients of a policy server."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from league.policies.policy import Policy
    from league.registry.registry import Registry


def load(ref: str, policy: str | None = None, registry: "Registry | None" = None) -> "Policy":
    """The policy that a reference names, see `league.policies.loading.load`."""
    from league.policies import loading

    return loading.load(ref, policy, registry)
