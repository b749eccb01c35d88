"""Models of other servers as contestants, called by the Open Inference Protocol over REST.

A reference is the URL of a model, `http://host:8000/v2/models/NAME`. docs/bots.md describes it for users. Inputs and
outputs of a model are matched by name, and otherwise by datatype and shape, if only one fits.
"""

import os
from dataclasses import dataclass, field
from typing import Any

import httpx
import numpy as np
from numpy.typing import NDArray

from league.errors import ConfigError, EnvironmentMismatch, RemoteError
from league.interface import AgentInterface, Interface, digest
from league.policies.draws import Generators
from league.policies.onnx import ACTION, DIST_INPUTS, STATE_IN, STATE_OUT
from league.policies.policy import Actions, Arrays, MalformedAction
from league.refs import RemoteRef
from league.spaces import ACTION_MASK, Box, DictSpace, Discrete, Leaf, MultiDiscrete, inputs
from league.spaces.arrays import bounds
from policy_league_client import Client
from policy_league_client.calls import ApiCall
from policy_league_client.requests import JsonObject, to_json

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


KEY_VARIABLE = "LEAGUE_REMOTE_API_KEY"
"""Environment variable with the API keys for servers of remote models: `SERVER=KEY`, separated by spaces."""
MAX_ROWS = 256
"""Rows of one request."""
TIMEOUT = 10.0
"""Seconds allowed for one attempt."""
RETRY_DEADLINE = 30.0
"""Seconds after the first attempt within which a failed request is retried."""


class OpenInferencePolicy:
    """A model of another server. Its actions are those that the server returns, or the best by its logits.

    Args:
        ref: The model.
        policy: Name of the policy in the league.
        spaces: The policy's observation and action space.

    Raises:
        ConfigError: LEAGUE_REMOTE_API_KEY is malformed.
        EnvironmentMismatch: The model's metadata do not fit the spaces.
        RemoteError: The server cannot be reached, failed, or no longer has this version.
    """

    def __init__(self, ref: RemoteRef, policy: str, spaces: AgentInterface) -> None:
        self._ref, self._spaces, self._path = ref, spaces, ref.path(policy)
        self._client = Client(ref.server, key=_key_for(ref.server), timeout=TIMEOUT, retry_deadline=RETRY_DEADLINE)
        self.metadata: JsonObject = self._client.send(ApiCall(self._path, lambda document, _: document))
        self._signature: RemoteSignature = read_signature(str(ref), self.metadata, spaces)

    def act(
        self,
        observations: Arrays,
        *,
        state: Arrays | None = None,
        explore: bool = False,  # noqa: ARG002
        rng: Generators | None = None,  # noqa: ARG002
    ) -> Actions:
        """Choose actions for a batch; see `Policy.act`.

        Raises:
            MalformedAction: The response contains no action of the space.
            RemoteError: The server cannot be reached, failed, or answered with another version.
        """
        rows = len(next(iter(observations.values())))
        arrays = dict(observations) | (dict(state) if state else self.initial_state(rows))
        parts = [
            self._infer({name: array[begin : begin + MAX_ROWS] for name, array in arrays.items()})
            for begin in range(0, rows, MAX_ROWS)
        ]
        after = {name: np.concatenate([part[name] for part in parts]) for name in self._signature.state}
        return Actions(np.concatenate([self._actions(part) for part in parts]), after or None)

    def initial_state(self, batch: int) -> dict[str, NDArray]:
        """Return the recurrent state at the start of `batch` episodes; empty for models without state."""
        return {name: np.zeros((batch, *leaf.shape), leaf.dtype) for name, leaf in self._signature.state.items()}

    def answering_version(self) -> str | None:
        """Return the version that answers a request; None if the server does not name it. Raises RemoteError."""
        sample = {name: _sample(name, leaf)[np.newaxis] for name, leaf in inputs(self._spaces.observation).items()}
        version = self._call(sample | self.initial_state(1)).get("model_version")
        return str(version) if version else None

    def close(self) -> None:
        """Close the connections."""
        self._client.close()

    def _infer(self, given: Arrays) -> dict[str, NDArray]:
        """Outputs and states by name, and the mask of the request."""
        response = self._call(given)
        version, expected = response.get("model_version"), self._ref.version
        if expected is not None and version and str(version) != expected:
            raise RemoteError(f"{self._ref} answered with version {version}, another contestant")
        rows = len(next(iter(given.values())))
        outputs = {output["name"]: output for output in response.get("outputs", ())}
        arrays = {self._signature.output: _array(outputs, self._signature.output, rows)}
        for name, leaf in self._signature.state.items():
            arrays[name] = _array(outputs, self._signature.next_state(name), rows).astype(leaf.dtype)
        return arrays | {name: array for name, array in given.items() if name == ACTION_MASK}

    def _call(self, given: Arrays) -> JsonObject:
        body: JsonObject = {
            "inputs": [
                {
                    "name": name,
                    "datatype": DATATYPES[given[key].dtype.name],
                    "shape": given[key].shape,
                    "data": np.ascontiguousarray(given[key]).reshape(-1),
                }
                for name, key in self._signature.inputs.items()
            ],
            "outputs": [{"name": name} for name in self._signature.requested],
        }
        return self._client.send(ApiCall(f"{self._path}/infer", lambda document, _: document, to_json(body)))

    def _actions(self, outputs: Arrays) -> NDArray:
        output, space = outputs[self._signature.output], self._spaces.action
        if self._signature.is_logits:
            assert isinstance(space, Discrete)
            mask = outputs.get(ACTION_MASK)
            allowed = output if mask is None else np.where(mask != 0, output, -np.inf)
            return allowed.argmax(axis=1) + space.start
        kinds = "iuf" if isinstance(space, Box) else "iu"
        assert isinstance(space, Box | Discrete | MultiDiscrete)
        if output.dtype.kind not in kinds or output.shape[1:] != space.shape:
            raise MalformedAction(f"{self._ref} returned {output.dtype} {list(output.shape)}: expected {space!r}")
        return output.astype(space.dtype)


def _key_for(server: str) -> str:
    """Return the API key for a server, empty if there is none. Raises ConfigError, without the keys."""
    keys = {}
    for entry in os.environ.get(KEY_VARIABLE, "").split():
        owner, _, key = entry.partition("=")
        if not owner.startswith(("http://", "https://")) or not key:
            raise ConfigError(
                f"{KEY_VARIABLE} has an entry without a server: expected SERVER=KEY, such as {server}=KEY, "
                "separated by spaces"
            )
        keys[_origin(owner)] = key
    return keys.get(_origin(server), "")


def _origin(server: str) -> tuple[str, str, int | None]:
    try:
        url = httpx.URL(server)
    except httpx.InvalidURL:
        raise ConfigError(f"{KEY_VARIABLE}: {server!r} is not the address of a server") from None
    return url.scheme, url.host, url.port  # a default port is None


def fixed_version(ref: RemoteRef, interface: Interface) -> RemoteRef:
    """Return a reference to the version that answers now, which identifies the contestant in the ledger.

    A server that does not name versions is identified by a digest of the model's metadata.

    Raises:
        EnvironmentMismatch: The model does not fit the interface, or its metadata have another digest.
        RemoteError: The server cannot be reached or failed.
    """
    policies = remote_policies(ref, interface)
    try:
        version = next(iter(policies.values())).answering_version()
        if version is not None:
            return RemoteRef(ref.server, ref.model, version)
        return RemoteRef(ref.server, ref.model, ref.version, _digest(policies))
    finally:
        for policy in policies.values():
            policy.close()


def remote_policies(ref: RemoteRef, interface: Interface) -> dict[str, OpenInferencePolicy]:
    """Connect to the model of each policy; see `OpenInferencePolicy`.

    Raises EnvironmentMismatch also if the metadata have another digest than the reference.
    """
    policies = {
        policy: OpenInferencePolicy(ref, policy, interface.of_policy(policy)) for policy in interface.policy_ids
    }
    if ref.digest is not None and (metadata_digest := _digest(policies)) != ref.digest:
        raise EnvironmentMismatch(
            f"the metadata of {ref.default} have changed to #{metadata_digest}: another contestant"
        )
    return policies


def _digest(policies: dict[str, OpenInferencePolicy]) -> str:
    return digest({name: policy.metadata for name, policy in policies.items()})[:12]


def _array(outputs: dict[str, Any], name: str, rows: int) -> NDArray:
    """An output as an array (rows, …). Raises MalformedAction."""
    if name not in outputs:
        raise MalformedAction(f"the response has no output {name!r}")
    try:
        array = np.array(outputs[name]["data"]).reshape(outputs[name]["shape"])
    except (KeyError, TypeError, ValueError) as error:
        raise MalformedAction(f"output {name!r} is no tensor: {error}") from error
    if array.ndim == 0 or len(array) != rows or array.dtype.kind not in "biuf":
        raise MalformedAction(f"output {name!r} is {array.dtype} {list(array.shape)}, expected {rows} rows of numbers")
    return array


def _sample(name: str, leaf: Leaf) -> NDArray:
    """An element of the space; of a mask the one that allows all actions."""
    if name == ACTION_MASK:
        return np.ones(leaf.shape, leaf.dtype)
    if isinstance(leaf, Box):
        return np.clip(0.0, *bounds(leaf)).astype(leaf.dtype)
    start = leaf.start if isinstance(leaf, Discrete | MultiDiscrete) else 0
    return np.broadcast_to(np.asarray(start), leaf.shape).astype(leaf.dtype)
