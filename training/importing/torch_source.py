"""Import of PyTorch modules and `torch.export` programs: converted to ONNX, compared with the module itself."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from league.errors import ConfigError, EnvironmentMismatch, InvalidInput, one_line
from league.interface import AgentInterface
from league.spaces import ACTION_MASK, DictSpace
from training.export.onnx_export import onnx_program
from training.importing.adapted_graph import BATCH, decoded
from training.importing.graph_mapping import GraphMapping, inferred
from training.importing.source import Source, State, checked

Examples = dict[str, tuple[tuple[int, ...], torch.dtype]]
"""Input of a module → shape without the batch, and dtype"""


class ModuleOriginal:
    """A PyTorch module without state. Actions are computed from its output in NumPy."""

    def __init__(self, module: nn.Module, examples: Examples, mapping: GraphMapping, spaces: AgentInterface) -> None:
        assert not isinstance(spaces.action, DictSpace)
        self._module, self._examples, self._mapping, self._action = module, examples, mapping, spaces.action

    def initial_state(self, rows: int) -> State:  # noqa: ARG002
        """Return no state."""
        return {}

    def act(self, observations: Mapping[str, NDArray], state: State) -> tuple[NDArray, NDArray | None, State]:
        """Run the module."""
        arguments = []
        for name, (shape, dtype) in self._examples.items():
            input_mapping = self._mapping.inputs[name]
            value = torch.from_numpy(np.ascontiguousarray(observations[input_mapping.name])).to(dtype)
            if input_mapping.transpose:
                value = value.permute(0, *(axis + 1 for axis in input_mapping.transpose))
            arguments.append(value.reshape(-1, *shape))
        with torch.no_grad():
            value = self._module(*arguments).numpy()
        return *decoded(value, observations.get(ACTION_MASK), self._mapping, self._action), state


def converted(module: nn.Module, examples: Examples, output: str, source: str) -> onnx.ModelProto:
    """Return the graph of a module with these inputs and one output. Raises InvalidInput if it cannot be converted."""
    # Two rows: torch.export treats a batch of one as constant.
    tensors = tuple(torch.zeros((2, *shape), dtype=dtype) for shape, dtype in examples.values())
    try:
        dynamic_shapes = tuple({0: torch.export.Dim(BATCH)} for _ in tensors)
        program = onnx_program(module.eval(), tensors, list(examples), [output], dynamic_shapes=dynamic_shapes)
    except Exception as error:
        cause = one_line(error.__cause__ or error)[:300]
        raise InvalidInput(f"{source}: the model cannot be converted to ONNX: {cause}") from error
    return program.model_proto


def torch_source(path: Path, mapping: Path | None, spaces: AgentInterface, origin: dict[str, Any]) -> Source:
    """Read a program that `torch.export.save` wrote, with a dynamic batch size and one output.

    This unpickles parts of the file and evaluates expressions in it.

    Args:
        path: The file.
        mapping: File with a GraphMapping; by default it is inferred.
        spaces: Spaces of the policy.
        origin: Recorded in the manifest.

    Raises:
        ConfigError: The file cannot be read.
        EnvironmentMismatch: The program does not fit the spaces.
        InvalidInput: The program cannot be converted to ONNX.
    """
    try:
        program = torch.export.load(str(path))
    except Exception as error:
        raise ConfigError(f"{path}: not a torch.export program: {one_line(error)}") from error
    names = [spec.arg.name for spec in program.graph_signature.input_specs if spec.kind.name == "USER_INPUT"]
    placeholders = {node.name: node.meta["val"] for node in program.graph.nodes if node.op == "placeholder"}
    examples: Examples = {name: _example(path, name, placeholders[name]) for name in names}
    outputs = program.graph_signature.user_outputs
    if len(outputs) != 1:
        raise EnvironmentMismatch(f"{path}: the program has {len(outputs)} outputs, expected the one that decides")
    model = onnx_program(program, (), names, ["output"]).model_proto
    graph_mapping = GraphMapping.load(mapping) if mapping else inferred(model, spaces, str(path))
    model = checked(model, graph_mapping, spaces, str(path))
    original = ModuleOriginal(_Called(program.module()), examples, graph_mapping, spaces)
    return Source(model, graph_mapping, original, origin, inferred=mapping is None)


class _Called(nn.Module):
    """The module of a program, which cannot be set to evaluation mode."""

    def __init__(self, module: nn.Module) -> None:
        super().__init__()
        self._called = module

    def forward(self, *arguments: Tensor) -> Tensor:
        return self._called(*arguments)


def _example(path: Path, name: str, value: Tensor) -> tuple[tuple[int, ...], torch.dtype]:
    batch: Any = value.shape[0]
    if type(batch) is int:
        raise EnvironmentMismatch(
            f"{path}: input {name} has a fixed batch size of {batch}; "
            "export it with dynamic_shapes={0: torch.export.Dim('batch')}"
        )
    return tuple(int(size) for size in value.shape[1:]), value.dtype
