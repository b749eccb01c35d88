"""A model to import: its graph, how the graph corresponds to a policy, and the original to compare with."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import onnx
from numpy.typing import NDArray

from league.errors import ConfigError, GraphTimeout, InvalidInput, LeagueError, one_line
from league.interface import AgentInterface
from league.policies.actions import dist_inputs_size
from league.policies.graph_runs import open_session, run_graph
from league.policies.onnx import RUN_TIMEOUT
from league.spaces import ACTION_MASK, DictSpace
from training.importing.adapted_graph import check, decoded
from training.importing.git_lfs import require_content
from training.importing.graph_bounds import bounded
from training.importing.graph_mapping import GraphMapping, batch_axis, graph_inputs, inferred

State = dict[str, NDArray]
"""Recurrent input of the source's graph → (k, …), with the batch as first axis whatever its order in the graph"""


class Original(Protocol):
    """The model in the program that it was made with."""

    def initial_state(self, rows: int) -> State:
        """Return the state at the start of episodes."""

    def act(self, observations: Mapping[str, NDArray], state: State) -> tuple[NDArray, NDArray | None, State]:
        """Return greedy actions (k, …), the logits or None, and the states after."""


@dataclass(frozen=True, slots=True)
class Source:
    """A model to import as one policy.

    Attributes:
        origin: What the manifest records: format, file, digest, mapping.
        inferred: Whether nobody said what the output means.
    """

    model: onnx.ModelProto
    mapping: GraphMapping
    original: Original
    origin: dict[str, Any]
    inferred: bool = False


class OnnxOriginal:
    """A foreign graph, run by ONNX Runtime. Actions are computed from its output in NumPy."""

    def __init__(self, model: onnx.ModelProto, mapping: GraphMapping, spaces: AgentInterface, source: str) -> None:
        try:
            self._session = open_session(model.SerializeToString())
        except Exception as error:
            raise InvalidInput(f"{source}: ONNX Runtime cannot load the graph: {one_line(error)}") from error
        assert not isinstance(spaces.action, DictSpace)
        self._given, self._mapping, self._action, self._source = graph_inputs(model), mapping, spaces.action, source

    def initial_state(self, rows: int) -> State:
        """Return zeros."""
        tensors = {name: self._given[name] for name in self._mapping.state}
        return {
            name: np.zeros((rows, *(size for size in shape if size is not None)), dtype)
            for name, (dtype, shape) in tensors.items()
        }

    def act(self, observations: Mapping[str, NDArray], state: State) -> tuple[NDArray, NDArray | None, State]:
        """Run the graph. Raises InvalidInput if it fails."""
        axes = {name: batch_axis(self._given[name][1]) for name in self._mapping.state}
        feed = {name: np.ascontiguousarray(np.moveaxis(value, 0, axes[name])) for name, value in state.items()}
        for name, input_mapping in self._mapping.inputs.items():
            dtype, shape = self._given[name]
            value = observations[input_mapping.name].astype(dtype)
            if input_mapping.transpose:
                value = value.transpose(0, *(axis + 1 for axis in input_mapping.transpose))
            feed[name] = value if None in shape[1:] else value.reshape(-1, *shape[1:])
        try:
            results = [self._mapping.output, *self._mapping.state.values()]
            value, *after = run_graph(self._session, results, feed, RUN_TIMEOUT)
        except GraphTimeout as error:
            raise GraphTimeout(f"{self._source}: {error}") from error
        except Exception as error:
            raise InvalidInput(f"{self._source}: the graph fails on observations: {one_line(error)}") from error
        actions, logits = decoded(value, observations.get(ACTION_MASK), self._mapping, self._action)
        states = zip(axes.items(), after, strict=True)
        return actions, logits, {name: np.moveaxis(value, axis, 0) for (name, axis), value in states}


def onnx_source(path: Path, mapping: Path | None, spaces: AgentInterface, origin: dict[str, Any]) -> Source:
    """Read an ONNX file.

    Args:
        path: The file. Weights in separate files next to it are included.
        mapping: File with a GraphMapping; by default `path` with the suffix .yaml if it exists, else it is inferred.
        spaces: Spaces of the policy.
        origin: Recorded in the manifest.

    Raises:
        ConfigError: A file cannot be read.
        EnvironmentMismatch: The graph does not fit the spaces.
    """
    try:
        model = onnx.load(str(path), load_external_data=False)
        entries = [entry for weight in model.graph.initializer for entry in weight.external_data]
        for file in {entry.value for entry in entries if entry.key == "location"}:
            require_content(path.parent / file)
        onnx.load_external_data_for_model(model, str(path.parent))
        onnx.checker.check_model(model)
    except LeagueError:
        raise
    except Exception as error:
        raise ConfigError(f"{path}: not an ONNX model: {one_line(error)}") from error
    beside = path.with_suffix(".yaml")
    file = mapping or (beside if beside.exists() else None)
    names = GraphMapping.load(file) if file else inferred(model, spaces, str(path))
    model = checked(model, names, spaces, str(path))
    return Source(model, names, OnnxOriginal(model, names, spaces, str(path)), origin, inferred=file is None)


def checked(model: onnx.ModelProto, mapping: GraphMapping, spaces: AgentInterface, source: str) -> onnx.ModelProto:
    """Return a model whose time and memory are bounded; see `bounded`. Raises EnvironmentMismatch if the mapping does
    not fit, and InvalidInput.
    """
    check(model, mapping, spaces, source)
    return bounded(model, mapping, spaces, source)


def known_logits(logits: NDArray | None, actions: NDArray, spaces: AgentInterface) -> NDArray:
    """Logits for the search for near ties; without logits, no difference is excused."""
    if logits is not None:
        return logits
    widths = np.arange(dist_inputs_size(spaces.action), dtype=np.float32)
    return np.tile(widths, (len(actions), 1))
