"""Which tensors of a remote model are the observation, the action and the recurrent state.

Inputs and outputs are matched by name, and otherwise by datatype and shape, if only one fits.
"""

from dataclasses import dataclass, field
from typing import Any

from league.errors import EnvironmentMismatch, RemoteError
from league.interface import AgentInterface
from league.policies.onnx import ACTION, DIST_INPUTS, STATE_IN, STATE_OUT
from league.spaces import ACTION_MASK, Box, DictSpace, Discrete, Leaf, inputs

DATATYPES = {
    "bool": "BOOL",
    "int8": "INT8",
    "int16": "INT16",
    "int32": "INT32",
    "int64": "INT64",
    "uint8": "UINT8",
    "uint16": "UINT16",
    "uint32": "UINT32",
    "uint64": "UINT64",
    "float16": "FP16",
    "float32": "FP32",
    "float64": "FP64",
}
"""NumPy dtype → datatype of the Open Inference Protocol."""
DTYPES = {datatype: dtype for dtype, datatype in DATATYPES.items()}
_INTEGERS, _FLOATS = ("INT", "UINT"), ("FP",)


@dataclass(frozen=True, slots=True)
class RemoteSignature:
    """The tensors of a model that a policy uses.

    Attributes:
        inputs: Input of the model → name of our array.
        output: The output that determines the action.
        is_logits: Whether the output contains logits or values of all actions.
        state: Recurrent inputs by name, with shape and dtype.
    """

    inputs: dict[str, str]
    output: str
    is_logits: bool
    state: dict[str, Leaf] = field(default_factory=dict)

    @property
    def requested(self) -> list[str]:
        """The outputs to request."""
        return [self.output, *map(self.next_state, self.state)]

    @staticmethod
    def next_state(name: str) -> str:
        """The output with the next value of a recurrent input."""
        return STATE_OUT + name.removeprefix(STATE_IN)


def read_signature(name: str, metadata: dict[str, Any], spaces: AgentInterface) -> RemoteSignature:
    """Match the tensors of a model with the spaces of a policy.

    Args:
        name: Name of the model, for errors.
        metadata: The model's metadata in the protocol.
        spaces: The policy's observation and action space.

    Raises:
        EnvironmentMismatch: They do not match.
        RemoteError: These are not the metadata of a model.
    """
    input_tensors, output_tensors = _tensors(name, metadata, "inputs"), _tensors(name, metadata, "outputs")
    state = {key: _state(name, key, *tensor) for key, tensor in input_tensors.items() if key.startswith(STATE_IN)}
    for key in state:
        if RemoteSignature.next_state(key) not in output_tensors:
            raise EnvironmentMismatch(f"{name} has the input {key}, but no output {RemoteSignature.next_state(key)}")
    observed = _match_inputs(
        name, {key: input_tensors[key] for key in input_tensors if key not in state}, inputs(spaces.observation)
    )
    output, is_logits = _match_output(name, output_tensors, spaces)
    return RemoteSignature(observed | {key: key for key in state}, output, is_logits, state)


Tensors = dict[str, tuple[str, list[int]]]
"""name → datatype, and shape with the batch"""


def _tensors(name: str, metadata: dict[str, Any], kind: str) -> Tensors:
    try:
        tensors = {str(tensor["name"]): (str(tensor["datatype"]), list(tensor["shape"])) for tensor in metadata[kind]}
    except (KeyError, TypeError) as error:
        raise RemoteError(f"{name} does not describe its {kind} as the Open Inference Protocol requires") from error
    if not tensors:
        raise EnvironmentMismatch(f"{name} lists no {kind} in its metadata: they cannot be checked")
    return tensors


def _state(name: str, key: str, datatype: str, shape: list[int]) -> Leaf:
    if datatype not in DTYPES or any(size < 1 for size in shape[1:]):
        raise EnvironmentMismatch(f"{name}: the recurrent input {key} is {datatype} {shape}, expected fixed sizes")
    return Box(dtype=DTYPES[datatype], shape=tuple(shape[1:]), low=None, high=None)


def _match_inputs(name: str, given: Tensors, leaves: dict[str, Leaf]) -> dict[str, str]:
    """Input of the model → leaf of the observation."""
    matches: dict[str, str] = {}
    for key, (datatype, shape) in given.items():
        fitting = [
            leaf_name
            for leaf_name, leaf in leaves.items()
            if datatype == DATATYPES[leaf.dtype] and _fits(shape, leaf.shape)
        ]
        if key in leaves:
            fitting = [leaf_name for leaf_name in fitting if leaf_name == key]
        if len(fitting) != 1:
            expected = ", ".join(
                f"{leaf_name} {DATATYPES[leaf.dtype]} {[-1, *leaf.shape]}" for leaf_name, leaf in leaves.items()
            )
            raise EnvironmentMismatch(f"{name} has the input {key} {datatype} {shape}: expected {expected}")
        matches[key] = fitting[0]
    missing = set(leaves) - set(matches.values()) - {ACTION_MASK}
    if missing or len(set(matches.values())) < len(matches):
        problem = f"has no input for {sorted(missing)[0]}" if missing else "has two inputs for the same array"
        raise EnvironmentMismatch(f"{name} {problem}")
    return matches


def _match_output(name: str, returned: Tensors, spaces: AgentInterface) -> tuple[str, bool]:
    """The output that determines the action, and whether it contains logits."""
    action = spaces.action
    if isinstance(action, DictSpace):
        raise EnvironmentMismatch(f"{name} cannot play: remote models do not support dict actions")
    kinds = _INTEGERS + (_FLOATS if isinstance(action, Box) else ())
    action_outputs = [
        key for key, (kind, shape) in returned.items() if kind.startswith(kinds) and _fits(shape, action.shape)
    ]
    if isinstance(action, Discrete):
        logits = (action.n,)
        ranked = [key for key, (kind, shape) in returned.items() if kind.startswith(_FLOATS) and _fits(shape, logits)]
    else:
        ranked = []
    for candidates, preferred, is_logits in ((action_outputs, ACTION, False), (ranked, DIST_INPUTS, True)):
        if preferred in candidates or len(candidates) == 1:
            return preferred if preferred in candidates else candidates[0], is_logits
    outputs = ", ".join(f"{key} {kind} {shape}" for key, (kind, shape) in returned.items())
    logits_too = f", or logits FP32 {[-1, action.n]}" if isinstance(action, Discrete) else ""
    raise EnvironmentMismatch(
        f"{name} returns {outputs}: expected {ACTION} {DATATYPES[action.dtype]} {[-1, *action.shape]}{logits_too}"
    )


def _fits(shape: list[int], row: tuple[int, ...]) -> bool:
    """Whether a tensor's shape, with -1 for any size, is a batch of rows of this shape."""
    return len(shape) == 1 + len(row) and all(
        size in (-1, row_size) for size, row_size in zip(shape[1:], row, strict=True)
    )
