"""Models of other servers as contestants, called by the Open Inference Protocol over REST.

A reference is the URL of a model, `http://host:8000/v2/models/NAME`. docs/bots.md describes it for users.
"""

import os
from typing import Any

import httpx
import numpy as np
from numpy.typing import NDArray

from league.errors import ConfigError, EnvironmentMismatch, RemoteError
from league.interface import AgentInterface, Interface, digest
from league.policies.draws import Generators
from league.policies.open_inference_signature import DATATYPES, RemoteSignature, read_signature
from league.policies.policy import Actions, Arrays, MalformedAction
from league.refs import RemoteRef
from league.spaces import ACTION_MASK, Box, Discrete, Leaf, MultiDiscrete, inputs
from league.spaces.arrays import bounds
from policy_league_client import Client
from policy_league_client.calls import ApiCall
from policy_league_client.requests import JsonObject, to_json

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
