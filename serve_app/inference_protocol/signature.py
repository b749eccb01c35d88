"""What a policy takes and gives under this protocol: names, datatypes and shapes, as its manifest has them."""

from dataclasses import dataclass

from league.policies.onnx import ACTION, DIST_INPUTS, STATE_OUT
from league.registry.manifest import PolicyManifest
from league.spaces import ACTION_MASK, Box, Leaf, inputs
from serve_app.inference_protocol.datatypes import DATATYPES


@dataclass(frozen=True, slots=True)
class Port:
    """One input or output."""

    name: str
    datatype: str
    leaf: Leaf
    """Shape of a row, dtype, and what its elements may be."""
    is_state: bool = False
    """Recurrent state, which may be left out at the start of an episode: it is zeros then."""


@dataclass(frozen=True, slots=True)
class Signature:
    """The inputs and outputs of a policy, by name, in the manifest's order."""

    inputs: dict[str, Port]
    outputs: dict[str, Port]
    is_masked: bool

    @property
    def is_recurrent(self) -> bool:
        return any(port.is_state for port in self.inputs.values())


def signature_of(manifest: PolicyManifest) -> Signature:
    """Inputs are the leaves of the observation, then the recurrent state; outputs are what `Actions` holds."""
    observed = {name: _port(name, leaf) for name, leaf in inputs(manifest.observation).items()}
    state = {tensor.name: _port(tensor.name, _leaf(tensor.dtype, tensor.shape), True) for tensor in manifest.state}
    answered = {
        tensor.name: _port(tensor.name, _leaf(tensor.dtype, tensor.shape))
        for tensor in manifest.outputs
        if tensor.name in (ACTION, DIST_INPUTS) or tensor.name.startswith(STATE_OUT)
    }
    return Signature(observed | state, answered, ACTION_MASK in observed)


def _port(name: str, leaf: Leaf, is_state: bool = False) -> Port:
    return Port(name, DATATYPES[leaf.dtype], leaf, is_state)


def _leaf(dtype: str, shape: tuple[int | None, ...]) -> Leaf:
    """A tensor without its batch, which is its only dimension of no fixed size."""
    return Box(dtype=dtype, shape=tuple(size for size in shape[1:] if size is not None), low=None, high=None)
