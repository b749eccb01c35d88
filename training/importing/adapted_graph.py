"""Extends a foreign graph to the interface of a policy graph: casts before it, masks and the greedy action after it."""

from collections.abc import Callable

import numpy as np
import onnx
from numpy.typing import DTypeLike, NDArray
from onnx import NodeProto, ValueInfoProto, compose, helper, numpy_helper, version_converter

from league.errors import EnvironmentMismatch, one_line
from league.interface import AgentInterface
from league.policies.actions import dist_inputs_size, to_environment
from league.policies.draws import elements
from league.policies.onnx import ACTION, DIST_INPUTS, STATE_IN, STATE_OUT
from league.registry.storage.manifest import Tensor
from league.spaces import ACTION_MASK, Box, DictSpace, Discrete, Leaf, MultiDiscrete, inputs
from league.spaces.arrays import bounds
from training.importing.graph_mapping import GraphMapping, InputMapping, Shape, batch_axis, graph_inputs, tensors

OPSET = 18
BATCH = "batch"
PREFIX = "imported/"
CERTAIN = 20.0
"""Logit of the action that a graph has chosen itself, and minus the log standard deviation of such a Gaussian."""
LEAST = np.finfo(np.float32).tiny
"""Probability instead of 0, whose logarithm is not finite."""

Tensors = tuple[Tensor, ...]


def adapt(model: onnx.ModelProto, mapping: GraphMapping, spaces: AgentInterface, source: str) -> bytes:
    """Return `model` with the inputs and outputs of a policy graph; see `graph_tensors`.

    Raises:
        EnvironmentMismatch: The mapping does not fit the graph or the spaces. The message names `source`.
    """
    check(model, mapping, spaces, source)
    action = spaces.action
    assert not isinstance(action, DictSpace), "check refuses it"
    # The added nodes are defined in OPSET.
    current = next((opset.version for opset in model.opset_import if opset.domain in ("", "ai.onnx")), OPSET)
    try:
        upgraded = model if current >= OPSET else version_converter.convert_version(model, OPSET)
    except Exception as error:
        raise EnvironmentMismatch(
            f"{source}: opset {current} cannot be converted to {OPSET}: {one_line(error)}"
        ) from error
    builder = _Builder(upgraded)
    model_inputs = graph_inputs(model)
    leaves = inputs(spaces.observation)
    for name, input_mapping in mapping.inputs.items():
        dtype, shape = model_inputs[name]
        builder.feed(input_mapping, leaves[input_mapping.name], PREFIX + name, dtype, shape)
    for number, (name, after) in enumerate(mapping.state.items()):
        _, shape = model_inputs[name]
        builder.move_axis(f"{STATE_IN}{number}", PREFIX + name, len(shape), 0, batch_axis(shape))
        builder.move_axis(PREFIX + after, f"{STATE_OUT}{number}", len(shape), batch_axis(shape), 0)
    masked = ACTION_MASK in leaves
    if isinstance(action, Box):
        builder.box(PREFIX + mapping.output, mapping, action)
    elif mapping.kind == "action":
        builder.chosen(PREFIX + mapping.output, action)
    else:
        builder.logits(PREFIX + mapping.output, mapping, action, masked)
    input_tensors, output_tensors, _ = graph_tensors(model, mapping, spaces)
    return builder.serialized(input_tensors, output_tensors)


def graph_tensors(
    model: onnx.ModelProto, mapping: GraphMapping, spaces: AgentInterface
) -> tuple[Tensors, Tensors, Tensors]:
    """Return inputs, outputs and recurrent inputs of the adapted graph for its manifest."""
    model_inputs, action = graph_inputs(model), spaces.action
    assert not isinstance(action, DictSpace), "check refuses it"
    observed = tuple(
        Tensor(name=name, dtype=leaf.dtype, shape=(None, *leaf.shape))
        for name, leaf in inputs(spaces.observation).items()
        if name == ACTION_MASK or name in {input_mapping.name for input_mapping in mapping.inputs.values()}
    )
    before, after = (
        tuple(
            Tensor(name=f"{prefix}{number}", dtype=dtype, shape=(None, *(size for size in shape if size is not None)))
            for number, (dtype, shape) in enumerate(model_inputs[name] for name in mapping.state)
        )
        for prefix in (STATE_IN, STATE_OUT)
    )
    acted = (
        Tensor(name=ACTION, dtype=action.dtype, shape=(None, *action.shape)),
        Tensor(name=DIST_INPUTS, dtype="float32", shape=(None, dist_inputs_size(action))),
    )
    return (*observed, *before), (*acted, *after), before


def check(model: onnx.ModelProto, mapping: GraphMapping, spaces: AgentInterface, source: str) -> None:
    """Raise EnvironmentMismatch unless `mapping` names tensors of the graph, with fitting kinds and sizes."""
    model_inputs, results, leaves = graph_inputs(model), tensors(list(model.graph.output)), inputs(spaces.observation)

    def refuse(problem: str) -> None:
        raise EnvironmentMismatch(f"{source}: {problem}")

    if missing := sorted(model_inputs.keys() - mapping.inputs.keys() - mapping.state.keys()):
        refuse(f"input {missing[0]} of the graph is not in the mapping")
    for name, (_, shape) in model_inputs.items():
        if name not in mapping.state and shape[:1] not in ((), (None,)):
            refuse(
                f"input {name} has a fixed batch size of {shape[0]}: export it with a dynamic one, in PyTorch with"
                " torch.export.Dim('batch') as its axis 0 in dynamic_shapes, and example inputs of two or more rows"
            )
    for name, input_mapping in mapping.inputs.items():
        if name not in model_inputs:
            refuse(f"inputs.{name}: the graph has the inputs {', '.join(model_inputs)}")
        if input_mapping.name not in leaves:
            refuse(f"inputs.{name}: the league has no {input_mapping.name}, expected one of {', '.join(leaves)}")
        _check_shape(model_inputs[name][1][1:], name, input_mapping, leaves[input_mapping.name].shape, refuse)
    for name in (mapping.output, *mapping.state.values()):
        if name not in results:
            refuse(f"output {name}: the graph has the outputs {', '.join(results)}")
    for name, after in mapping.state.items():
        if name not in model_inputs:
            refuse(f"state.{name}: the graph has the inputs {', '.join(model_inputs)}")
        _check_state(name, model_inputs[name][1], after, results[after][1], refuse)
    _check_output(results[mapping.output][1][1:], mapping, spaces, refuse)


def _check_state(name: str, shape: Shape, after: str, shape_after: Shape, refuse: Callable[[str], None]) -> None:
    free = [axis for axis, size in enumerate(shape) if size is None]
    if not free:
        refuse(
            f"state {name} has the fixed shape {list(shape)}: export it with a dynamic batch, in PyTorch with"
            " torch.export.Dim('batch') in dynamic_shapes, as axis 1 of (layers, batch, width), and example inputs of"
            " two or more rows"
        )
    if len(free) > 1:
        refuse(f"state {name} has the dynamic axes {free}: expected one, the batch, and fixed sizes of the others")
    # Without a shape, or with one that the exporter has not inferred, the output is known only when it runs.
    pairs = zip(shape, shape_after, strict=False)
    is_other = len(shape_after) != len(shape) or any(None not in pair and pair[0] != pair[1] for pair in pairs)
    if shape_after and (is_other or (None in shape_after and shape_after[free[0]] is not None)):
        refuse(f"output {after} has shape {_sizes(shape_after)}, but its state {name} has {_sizes(shape)}")


def _sizes(shape: Shape) -> str:
    return f"[{', '.join('batch' if size is None else str(size) for size in shape)}]"


def _check_shape(
    sizes: Shape,
    name: str,
    own: InputMapping,
    shape: tuple[int, ...],
    refuse: Callable[[str], None],
) -> None:
    if own.transpose and len(own.transpose) != len(shape):
        refuse(f"inputs.{name}.transpose: {own.name} has {len(shape)} axes, got {len(own.transpose)}")
    ordered = own.shape(shape)
    flattened = (int(np.prod(shape, dtype=int)),)
    if None not in sizes and sizes != ordered and (sizes != flattened):
        refuse(f"input {name} has shape {list(sizes)}, but {own.name} has {list(ordered)}")


def _check_output(sizes: Shape, mapping: GraphMapping, spaces: AgentInterface, refuse: Callable[[str], None]) -> None:
    if isinstance(spaces.action, DictSpace):
        refuse("dict actions are not supported")
    allowed = (
        ("gaussian", "action") if isinstance(spaces.action, Box) else ("logits", "probabilities", "values", "action")
    )
    if mapping.kind not in allowed:
        refuse(f"kind: {mapping.kind} does not fit {spaces.action.type} actions, expected one of {', '.join(allowed)}")
    width = dist_inputs_size(spaces.action)
    if mapping.kind != "action" and sizes not in ((width,), (None,)):
        refuse(f"output {mapping.output} has shape {list(sizes)}: {mapping.kind} have [{width}]")


class _Builder:
    """Adds nodes to a graph whose names have PREFIX."""

    def __init__(self, model: onnx.ModelProto) -> None:
        self._model = compose.add_prefix(model, PREFIX)
        self._before: list[NodeProto] = []
        self._after: list[NodeProto] = []
        self._names = iter(range(10**6))

    def feed(self, own: InputMapping, leaf: Leaf, name: str, dtype: str, shape: tuple[int | None, ...]) -> None:
        """Connect an input of the policy to one of the graph."""
        value = self._cast(own.name, leaf.dtype, dtype)
        if own.transpose:
            value = self._new("Transpose", [value], perm=[0, *(axis + 1 for axis in own.transpose)])
        if shape[1:] != own.shape(leaf.shape) and None not in shape[1:]:
            value = self._reshaped(value, shape[1:])
        self.node("Identity", [value], name)

    def move_axis(self, value: str, result: str, rank: int, first: int, last: int) -> None:
        """As `np.moveaxis`."""
        order = [axis for axis in range(rank) if axis != first]
        order.insert(last, first)
        self.node("Transpose", [value], result, perm=order)

    def logits(self, output: str, mapping: GraphMapping, action: Leaf, masked: bool) -> None:
        """Greedy action of masked logits, logarithms of probabilities, or action values."""
        value = self._cast(output, "", "float32")
        if mapping.kind == "probabilities":
            value = self._new("Log", [self._new("Max", [value, self._constant(LEAST)])])
        if masked:
            none = self._constant(np.zeros(1, np.float32))
            illegal = self._new("Equal", [self._cast(ACTION_MASK, "", "float32"), none])
            value = self._new("Where", [illegal, self._constant(np.finfo(np.float32).min), value])
        self.node("Identity", [value], DIST_INPUTS)
        if isinstance(action, MultiDiscrete):
            sizes = np.ravel(action.nvec).tolist()
            starts = np.cumsum([0, *sizes[:-1]]).tolist()
            parts = [
                self._best(self._slice(value, first, size), keep=1) for first, size in zip(starts, sizes, strict=True)
            ]
            raw_action = self._reshaped(self._new("Concat", parts, axis=1), action.shape)
        else:
            raw_action = self._best(value, keep=0)
        assert isinstance(action, Discrete | MultiDiscrete)
        moved = self._new("Add", [raw_action, self._constant(np.asarray(action.start, np.int64))])
        self.node("Identity", [self._cast(moved, "int64", action.dtype)], ACTION)

    def chosen(self, output: str, action: Leaf) -> None:
        """A finished integer action; its distribution is certain."""
        assert isinstance(action, Discrete | MultiDiscrete)
        whole = self._reshaped(self._cast(output, "", "int64"), action.shape)
        self.node("Identity", [self._cast(whole, "int64", action.dtype)], ACTION)
        raw = self._new("Sub", [whole, self._constant(np.asarray(action.start, np.int64))])
        columns = self._reshaped(raw, (int(np.prod(action.shape, dtype=int)),))
        sizes = [action.n] if isinstance(action, Discrete) else np.ravel(action.nvec).tolist()
        levels = self._constant(np.array([0.0, CERTAIN], np.float32))
        parts = []
        for element, size in enumerate(sizes):
            column = self._reshaped(self._slice(columns, element, 1), ())
            parts.append(self._new("OneHot", [column, self._constant(np.int64(size)), levels], axis=1))
        self.node("Concat", parts, DIST_INPUTS, axis=1)

    def box(self, output: str, mapping: GraphMapping, action: Box) -> None:
        """Continuous actions: see league/policies/actions.py."""
        size = int(np.prod(action.shape, dtype=int))
        low, high = (np.ravel(bound) for bound in bounds(action))
        value = self._cast(output, "", "float64")
        if mapping.kind == "action":
            means = self._reshaped(value, (size,))
            spread = self._new("Add", [self._new("Mul", [means, self._number(0.0)]), self._number(-CERTAIN)])
        else:
            means, spread = self._slice(value, 0, size), self._slice(value, size, size)
        scaled = np.isfinite(low) & np.isfinite(high)
        half = np.where(scaled, np.where(scaled, high, 1) / 2 - np.where(scaled, low, -1) / 2, 1.0)
        centre = np.where(scaled, np.where(scaled, high, 0) / 2 + np.where(scaled, low, 0) / 2, 0.0)
        if mapping.kind == "action" or mapping.units == "environment":
            means = self._new("Div", [self._new("Sub", [means, self._constant(centre)]), self._constant(half)])
            if mapping.kind != "action":
                spread = self._new("Sub", [spread, self._constant(np.log(half))])
        inside = self._new("Add", [self._new("Mul", [means, self._constant(half)]), self._constant(centre)])
        largest = float(np.finfo(action.dtype).max)
        inside = self._new("Max", [inside, self._constant(np.maximum(low, -largest))])
        inside = self._new("Min", [inside, self._constant(np.minimum(high, largest))])
        self.node("Identity", [self._cast(self._reshaped(inside, action.shape), "float64", action.dtype)], ACTION)
        both = self._new("Concat", [means, spread], axis=1)
        self.node("Identity", [self._cast(both, "float64", "float32")], DIST_INPUTS)

    def node(self, kind: str, values: list[str], result: str, **attributes: object) -> None:
        """Add a node before the graph if it computes one of its inputs, else after it."""
        target = self._before if result.startswith((PREFIX, "fed/")) else self._after
        target.append(helper.make_node(kind, values, [result], **attributes))

    def serialized(self, taken: Tensors, answered: Tensors) -> bytes:
        """The model with these inputs and outputs."""
        nodes = [*self._before, *self._model.graph.node, *self._after]
        graph = helper.make_graph(
            nodes,
            "policy",
            _infos(taken),
            _infos(answered),
            list(self._model.graph.initializer),
            sparse_initializer=list(self._model.graph.sparse_initializer),
        )
        model = helper.make_model(
            graph,
            opset_imports=list(self._model.opset_import),
            functions=list(self._model.functions),
            ir_version=self._model.ir_version,
        )
        return bytes(model.SerializeToString())

    def _new(self, kind: str, values: list[str], **attributes: object) -> str:
        # What depends on inputs of the policy only may be an input of the graph.
        is_before = all(not value.startswith((PREFIX, "adapted/")) for value in values)
        result = f"{'fed' if is_before else 'adapted'}/{next(self._names)}"
        self.node(kind, values, result, **attributes)
        return result

    def _constant(self, value: object) -> str:
        array = np.asarray(value)
        name = f"constant/{next(self._names)}"
        self._model.graph.initializer.append(numpy_helper.from_array(array, name))
        return name

    def _number(self, value: float) -> str:
        return self._constant(np.float64(value))

    def _cast(self, value: str, before: str, after: DTypeLike) -> str:
        if before == after:
            return value
        return self._new("Cast", [value], to=helper.np_dtype_to_tensor_dtype(np.dtype(after)))

    def _reshaped(self, value: str, shape: tuple[int | None, ...]) -> str:
        return self._new("Reshape", [value, self._constant(np.array([-1, *shape], np.int64))])

    def _slice(self, value: str, first: int, size: int) -> str:
        ends = [self._constant(np.array([number], np.int64)) for number in (first, first + size, 1)]
        return self._new("Slice", [value, *ends])

    def _best(self, value: str, keep: int) -> str:
        return self._new("ArgMax", [value], axis=1, keepdims=keep)


def _infos(described: Tensors) -> list[ValueInfoProto]:
    return [
        helper.make_tensor_value_info(
            tensor.name, helper.np_dtype_to_tensor_dtype(np.dtype(tensor.dtype)), [BATCH, *tensor.shape[1:]]
        )
        for tensor in described
    ]


def decoded(
    value: NDArray, mask: NDArray | None, mapping: GraphMapping, action: Leaf
) -> tuple[NDArray, NDArray | None]:
    """Return the greedy actions (k, …) for the output of the source, and its logits or values if it has them."""
    if mapping.kind == "action":
        actions = value.reshape(-1, *action.shape)
        if isinstance(action, Box):
            actions = np.clip(actions, *bounds(action))
        return actions.astype(action.dtype if isinstance(action, Box) else np.int64), None
    if isinstance(action, Box):
        means = value[:, : value.shape[1] // 2].reshape(-1, *action.shape)
        if mapping.units == "environment":
            return np.clip(means.astype(np.float64), *bounds(action)).astype(action.dtype), None
        return to_environment(means, action), None
    if mapping.kind == "probabilities":
        value = np.log(np.maximum(value, LEAST))
    allowed = value if mask is None else np.where(mask != 0, value, -np.inf)
    if isinstance(action, MultiDiscrete):
        raw = np.stack([part.argmax(axis=1) for part in elements(allowed, action)], axis=1)
    else:
        raw = allowed.argmax(axis=1)
    return to_environment(raw, action), value
