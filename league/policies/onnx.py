"""Runs the ONNX graph of a policy with ONNX Runtime on one thread."""

from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from league.errors import ArtifactCorrupt, EnvironmentMismatch, GraphTimeout, ObservationError, one_line
from league.policies.actions import dist_inputs_size, to_environment
from league.policies.draws import Generators, UniformNumbers, certain, sample
from league.policies.graph_runs import open_session, run_graph
from league.policies.policy import Actions, Arrays
from league.registry.storage.manifest import PolicyManifest
from league.spaces import OBSERVATION, Discrete, Space

ACTION = "action"
DIST_INPUTS = "action_dist_inputs"
VALUE = "value"
STATE_IN = "state_in_"
STATE_OUT = "state_out_"
LAST_ACTION = "state_in_action"
"""State of a graph with the previous action as input: raw action + 1, (k, 1) float32, initially 0. The graph returns
its greedy action here, which is replaced if another action is sampled."""

RUN_TIMEOUT = 60.0
"""Seconds after which a run is ended, where nobody waits for it."""

DTYPES = {"float": "float32", "double": "float64"}
"""Element types of ONNX Runtime whose names differ from NumPy's."""


class OnnxPolicy:
    """An ONNX graph as a policy. Stateless and thread-safe.

    Args:
        graph: Path or content of the ONNX file, which must contain its weights.
        manifest: Expected inputs, outputs and action space. Without it, the graph is not checked against them.
        has_distribution: Whether actions can be sampled; see `Manifest.has_distribution`. Otherwise they are greedy,
            also with `explore`: those have the probability 1.
        timeout: Seconds after which a run is ended. Its method then raises GraphTimeout.

    Raises:
        ArtifactCorrupt: The file is not an ONNX graph, or it does not match the manifest.
    """

    def __init__(
        self,
        graph: Path | str | bytes,
        manifest: PolicyManifest | None = None,
        has_distribution: bool = True,
        timeout: float = RUN_TIMEOUT,
    ) -> None:
        self._session = _session(graph if isinstance(graph, bytes) else Path(graph).read_bytes())
        self._inputs = {node.name: node for node in self._session.get_inputs()}
        self._outputs = {node.name: node for node in self._session.get_outputs()}
        _check_graph(self._inputs, self._outputs, manifest)
        self.has_distribution, self._timeout = has_distribution, timeout
        self._action = manifest.action if manifest else _discrete(self._outputs)
        self._observed = tuple(name for name in self._inputs if not name.startswith(STATE_IN))
        self._recurrent = tuple(name for name in self._inputs if name.startswith(STATE_IN))
        state_out = [STATE_OUT + name.removeprefix(STATE_IN) for name in self._recurrent]
        self._greedy = [ACTION, *state_out]
        self._exploring = [ACTION, DIST_INPUTS, *state_out]

    def act(
        self,
        observations: Arrays | NDArray,
        *,
        state: Arrays | None = None,
        explore: bool = False,
        rng: Generators | UniformNumbers | None = None,
    ) -> Actions:
        """Choose actions for a batch; see `Policy.act`. `dist_inputs` are returned only with `explore`.

        Args:
            observations: See `Policy.act`; or the array `observation` alone.
            state: Arrays (k, …) named `state_in_<i>`; None at the start of episodes.
            explore: See `Policy.act`.
            rng: See `Policy.act`.

        Raises:
            ObservationError: An array is missing or its shape or dtype does not fit the graph.
            EnvironmentMismatch: `explore` without a manifest, for an action space that the graph does not determine.
        """
        if explore and not self.has_distribution:
            return self.distribution(observations, state=state)
        if explore and self._action is None:
            raise EnvironmentMismatch("this policy cannot explore without a manifest, which defines its action space")
        outputs = self._run(observations, state, self._exploring if explore else self._greedy)
        if not explore or self._action is None:
            return Actions(outputs[0], self._state(outputs[1:]))
        raw, after = sample(outputs[1], self._action, rng), self._state(outputs[2:])
        if after is not None and LAST_ACTION in after:
            after[LAST_ACTION] = raw[:, np.newaxis].astype(np.float32) + 1
        return Actions(to_environment(raw, self._action), after, outputs[1])

    def distribution(self, observations: Arrays | NDArray, *, state: Arrays | None = None) -> Actions:
        """Choose greedy actions and return `dist_inputs`, too; see `act`. Without a distribution, the actions are
        certain.
        """
        outputs = self.outputs(observations, state=state)
        if self.has_distribution or self._action is None:
            return outputs
        return replace(outputs, dist_inputs=certain(outputs.actions, self._action))

    def outputs(self, observations: Arrays | NDArray, *, state: Arrays | None = None) -> Actions:
        """Return the outputs of the graph: like `distribution`, but `dist_inputs` are values if it computes values."""
        outputs = self._run(observations, state, self._exploring)
        return Actions(outputs[0], self._state(outputs[2:]), outputs[1])

    def _run(self, given: Arrays | NDArray, state: Arrays | None, outputs: list[str]) -> list[NDArray]:
        observations = {OBSERVATION: given} if isinstance(given, np.ndarray) else given
        try:
            feed = {name: observations[name] for name in self._observed}
            if self._recurrent:
                feed |= self.initial_state(len(feed[self._observed[0]])) if state is None else state
            if len({len(array) for array in feed.values()}) != 1:
                raise ValueError(f"rows differ: { {name: len(array) for name, array in feed.items()} }")
            return run_graph(self._session, outputs, feed, self._timeout)
        except GraphTimeout:
            raise
        except Exception as error:
            self._explain(observations, state)
            raise ObservationError(f"the graph does not accept its input: {one_line(error)}") from error

    def within(self, timeout: float) -> Self:
        """Return the same policy with another timeout in seconds."""
        policy = copy(self)
        policy._timeout = timeout
        return policy

    def initial_state(self, batch: int) -> dict[str, NDArray]:
        """Return the recurrent state at the start of `batch` episodes; empty for graphs without state."""
        return {
            name: np.zeros((batch, *self._inputs[name].shape[1:]), _dtype(self._inputs[name]))
            for name in self._recurrent
        }

    def _state(self, outputs: list[NDArray]) -> dict[str, NDArray] | None:
        return dict(zip(self._recurrent, outputs, strict=True)) if outputs else None

    def _explain(self, observations: Arrays, state: Arrays | None) -> None:
        """Raise ObservationError for the first array that does not fit the graph, if any."""
        arrays = dict(observations) | dict(state or {})
        for name in (*self._observed, *(self._recurrent if state is not None else ())):
            node = self._inputs[name]
            expected = f"expected a batch of {_dtype(node)} {list(node.shape[1:])}"
            if name not in arrays:
                raise ObservationError(f"{name} is missing: {expected}")
            array = arrays[name]
            if not isinstance(array, np.ndarray):
                raise ObservationError(f"{name} is not a NumPy array: {expected}")
            if array.dtype != _dtype(node) or list(array.shape[1:]) != list(node.shape[1:]):
                raise ObservationError(f"{name} is {array.dtype} {list(array.shape[1:])}: {expected}")


def _session(graph: bytes) -> Any:
    try:
        return open_session(graph)
    except Exception as error:
        raise ArtifactCorrupt(f"ONNX Runtime cannot load the graph: {one_line(error)}") from error


def _check_graph(inputs: dict[str, Any], outputs: dict[str, Any], manifest: PolicyManifest | None) -> None:
    required = {ACTION, DIST_INPUTS}
    required |= {STATE_OUT + name.removeprefix(STATE_IN) for name in inputs if name.startswith(STATE_IN)}
    if missing := sorted(required - set(outputs)):
        raise ArtifactCorrupt(f"the graph has no output {missing[0]}")
    if manifest is None:
        return
    for kind, nodes, tensors in (
        ("input", inputs, manifest.inputs),
        ("output", outputs, manifest.outputs),
    ):
        graph_dtypes = {name: _dtype(node) for name, node in nodes.items()}
        expected = {tensor.name: tensor.dtype for tensor in tensors}
        for name in sorted(graph_dtypes.keys() | expected.keys()):
            if graph_dtypes.get(name) != expected.get(name):
                raise ArtifactCorrupt(
                    f"{kind} {name} of the graph is {graph_dtypes.get(name, 'missing')}, "
                    f"but {expected.get(name, 'missing')} in the manifest"
                )
    found_size, size = outputs[DIST_INPUTS].shape[-1], dist_inputs_size(manifest.action)
    if isinstance(found_size, int) and found_size != size:
        raise ArtifactCorrupt(
            f"{DIST_INPUTS} of the graph has {found_size} values per row, but its action space requires {size}"
        )


def _dtype(node: Any) -> str:
    name = str(node.type).removeprefix("tensor(").removesuffix(")")
    return DTYPES.get(name, name)


def _discrete(outputs: dict[str, Any]) -> Space | None:
    """The action space of a graph with a single integer action."""
    action = outputs[ACTION]
    is_discrete = len(action.shape) == 1 and _dtype(action) in ("int32", "int64")
    return Discrete(n=outputs[DIST_INPUTS].shape[1]) if is_discrete else None
