"""How the inputs and outputs of a foreign graph correspond to those of a policy: given in a file, or inferred."""

from pathlib import Path
from typing import Any, Literal, Self

import onnx
import yaml
from onnx.helper import tensor_dtype_to_np_dtype
from pydantic import Field, ValidationError, field_validator, model_validator

from league.config.base import Part
from league.config.validation_errors import describe_validation_error, describe_yaml_error
from league.errors import ConfigError, EnvironmentMismatch
from league.interface import AgentInterface
from league.policies.actions import dist_inputs_size
from league.spaces import ACTION_MASK, Box, DictSpace, inputs

Kind = Literal["logits", "probabilities", "values", "gaussian", "action"]


class InputMapping(Part):
    """What an input of a graph receives."""

    name: str
    """`observation`, `observation.<key>` or `action_mask`."""
    transpose: tuple[int, ...] = ()
    """Order of the axes without the batch: [2, 0, 1] turns (height, width, channels) into (channels, height, width)."""

    @model_validator(mode="before")
    @classmethod
    def _from_yaml(cls, value: Any) -> Any:
        return {"name": value} if isinstance(value, str) else value

    @field_validator("transpose")
    @classmethod
    def _is_permutation(cls, value: tuple[int, ...]) -> tuple[int, ...]:
        if sorted(value) != list(range(len(value))):
            raise ValueError(f"expected each of the axes 0 to {len(value) - 1} once, got {list(value)}")
        return value

    def shape(self, shape: tuple[int, ...]) -> tuple[int, ...]:
        """Return the shape of an observation after the transposition."""
        return tuple(shape[axis] for axis in self.transpose) if self.transpose else shape


class GraphMapping(Part):
    """Names of a graph's tensors and the meaning of its output."""

    inputs: dict[str, InputMapping]
    """Input of the graph → what it receives."""
    output: str
    """The output that determines the action."""
    kind: Kind
    """logits, probabilities or values of Discrete and MultiDiscrete actions; means, then log standard deviations; or a
    finished action in the units of the action space."""
    units: Literal["normalized", "environment"] = "normalized"
    """Units of a Gaussian for actions with bounds: [-1, 1] stands for the bounds, or the units of the action space."""
    state: dict[str, str] = Field(default={})
    """Recurrent input → the output with its next value."""

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a YAML file. Raises ConfigError, which names the file and the key."""
        try:
            return cls.model_validate(document := yaml.safe_load(path.read_text(encoding="utf-8")))
        except OSError as error:
            raise ConfigError(f"{path}: {error.strerror or error}") from error
        except ValidationError as error:
            raise ConfigError(f"{path}: {describe_validation_error(error, document)}") from error
        except (yaml.YAMLError, ValueError, RecursionError) as error:
            raise ConfigError(f"{path}: {describe_yaml_error(error)}") from error


Shape = tuple[int | None, ...]


def tensors(nodes: list[onnx.ValueInfoProto]) -> dict[str, tuple[str, Shape]]:
    """Return name → dtype and shape of a graph's inputs or outputs. Free dimensions are None."""
    tensor_types = {}
    for node in nodes:
        kind = node.type.tensor_type
        shape = tuple(size.dim_value or None if size.HasField("dim_value") else None for size in kind.shape.dim)
        tensor_types[node.name] = (tensor_dtype_to_np_dtype(kind.elem_type).name, shape)
    return tensor_types


def inferred(model: onnx.ModelProto, spaces: AgentInterface, source: str) -> GraphMapping:
    """Match the tensors of `model` by name, else by shape and dtype.

    Raises:
        EnvironmentMismatch: A tensor has no match or several; the message names it and `source`.
    """
    model_inputs, results = graph_inputs(model), tensors(list(model.graph.output))
    leaves = inputs(spaces.observation)
    matched: dict[str, str] = {}
    state = {name: name.replace("_in", "_out") for name in model_inputs if name.replace("_in", "_out") in results}
    for name, (dtype, shape) in model_inputs.items():
        if name in state:
            continue
        open_leaves = {leaf_name: leaf for leaf_name, leaf in leaves.items() if leaf_name not in matched.values()}
        if name in open_leaves:
            matched[name] = name
            continue
        fits = [leaf_name for leaf_name, leaf in open_leaves.items() if shape[1:] == leaf.shape]
        if len(fits) > 1:
            fits = [leaf_name for leaf_name in fits if open_leaves[leaf_name].dtype == dtype] or fits
        if len(fits) > 1:
            fits = [leaf_name for leaf_name in fits if (leaf_name == ACTION_MASK) == ("mask" in name)]
        if len(fits) != 1:
            choices = ", ".join(
                f"{leaf_name} {leaf.dtype} {list(leaf.shape)}" for leaf_name, leaf in open_leaves.items()
            )
            raise EnvironmentMismatch(
                f"{source}: input {name} is {dtype} {list(shape[1:])}: expected {'one' if fits else 'one of'} "
                f"{choices or 'no further input'}; use a mapping file"
            )
        matched[name] = fits[0]
    output, kind = _output(
        {name: tensor_type for name, tensor_type in results.items() if name not in state.values()}, spaces, source
    )
    return GraphMapping(
        inputs={name: InputMapping(name=leaf_name) for name, leaf_name in matched.items()},
        output=output,
        kind=kind,
        state=state,
    )


def batch_axis(shape: Shape) -> int:
    """Return the axis of a recurrent state that is the batch: the only one without a fixed size.

    It is the second one in PyTorch's and ONNX's own order, (layers, batch, width). shape: `adapted_graph.check` accepts
    it.
    """
    return shape.index(None)


def graph_inputs(model: onnx.ModelProto) -> dict[str, tuple[str, Shape]]:
    """Return name → dtype and shape of the inputs that are not weights."""
    weights = {weight.name for weight in model.graph.initializer}
    return {name: tensor_type for name, tensor_type in tensors(list(model.graph.input)).items() if name not in weights}


def _output(results: dict[str, tuple[str, Shape]], spaces: AgentInterface, source: str) -> tuple[str, Kind]:
    """The output that determines the action: distribution inputs are preferred to a finished action."""
    action = spaces.action
    if isinstance(action, DictSpace):
        raise EnvironmentMismatch(f"{source}: dict actions are not supported")
    distribution: Kind = "gaussian" if isinstance(action, Box) else "logits"
    width = dist_inputs_size(action)
    floats = [name for name, (dtype, shape) in results.items() if dtype.startswith("float") and shape[1:] == (width,)]
    numbers = "float" if isinstance(action, Box) else ("int", "uint")
    finished = [
        name for name, (dtype, shape) in results.items() if dtype.startswith(numbers) and shape[1:] == action.shape
    ]
    kinds: tuple[tuple[list[str], Kind], ...] = ((floats, distribution), (finished, "action"))
    for names, kind in kinds:
        if len(names) == 1:
            return names[0], kind
    outputs = ", ".join(f"{name} {dtype} {list(shape[1:])}" for name, (dtype, shape) in results.items())
    raise EnvironmentMismatch(
        f"{source}: outputs are {outputs}: expected one float output [{width}] or one {action.dtype} action "
        f"{list(action.shape)}; use a mapping file"
    )
