"""Bounds time and memory of a foreign graph, before anything runs it.

An ONNX graph is data, but it may contain loops, and tensors whose sizes are computed. One whose `Loop` depends on an
observation would pass all checks in play, and then occupy a server for ever. Therefore a graph has operators of an
allowlist only, and the size of each tensor depends on shapes and constants, never on values of an input:

    local functions inlined → operators → for each node: shape of its outputs, memory, operations

Shapes are inferred node by node for the largest batch of a server. A result that a node computes from shapes and
constants is computed by ONNX Runtime itself, because it may be the size of another tensor. Unless the sizes are seen to
increase with the batch, all smaller batches are checked, too.
"""

from collections.abc import Iterable, Mapping
from itertools import pairwise
from math import prod
from typing import Any, NamedTuple

import numpy as np
import onnx
import onnx.inliner
from numpy.typing import NDArray
from onnx import AttributeProto, NodeProto, TensorProto, TypeProto, helper, numpy_helper, shape_inference

from league.errors import InvalidInput, one_line
from league.interface import AgentInterface
from league.policies.graph_runs import open_session
from league.policies.policy import MAX_BATCH
from league.spaces import inputs
from league.spaces.binary_leaves import MAX_DECODED_BYTES
from training.importing.graph_mapping import GraphMapping, graph_inputs

MAX_TENSOR, MAX_MEMORY = 2**30, 2 * 2**30
"""Bytes of one tensor, and of all that are needed at the same time."""
MAX_OPERATIONS = 2**35
"""Of one node, which cannot be interrupted: about a second on one core."""
MAX_NODES = 20_000
KNOWN = 1024
"""Elements of the largest tensor whose values are computed."""

Shape = tuple[int, ...]


def _operators(names: str) -> frozenset[str]:
    return frozenset(names.split())


POOLS = _operators("AveragePool LpPool MaxPool")
CONVOLUTIONS = _operators("Conv ConvInteger ConvTranspose QLinearConv")
PRODUCTS = _operators("Gemm MatMul MatMulInteger QLinearMatMul")
RECURRENT = _operators("GRU LSTM RNN")
COMPUTED = _operators(
    "Abs Add And Cast CastLike Ceil Clip Concat Constant ConstantOfShape Div Equal Expand Flatten Floor Gather Greater"
    " GreaterOrEqual Identity Less LessOrEqual Max Min Mod Mul Neg Not Or Range ReduceMax ReduceMin ReduceProd"
    " ReduceSum Reshape Round ScatterND Slice Split Sqrt Squeeze Sub Tile Transpose Unsqueeze Where Xor"
)
"""Operators that compute sizes."""
SMOOTH = _operators(
    "Cast Concat ConstantOfShape Expand Flatten Identity ReduceProd Reshape Squeeze Tile Transpose Unsqueeze"
)
"""Their results do not decrease if a size among their inputs increases. Those of `Add` and `Mul` do not if all are
positive, and those of `Gather`, `Slice` and `Split` do not if they select by constants."""
RESIZING = POOLS | CONVOLUTIONS | _operators("Pad Range Resize Slice Split TopK Upsample")
"""Operators that give an axis another size, which need not increase with it."""
ALLOWED = COMPUTED | POOLS | CONVOLUTIONS | PRODUCTS | RECURRENT
ALLOWED |= _operators(
    "Acos Acosh ArgMax ArgMin Asin Asinh Atan Atanh BatchNormalization BitShift BitwiseAnd BitwiseNot BitwiseOr"
    " BitwiseXor Celu Cos Cosh CumSum DepthToSpace DequantizeLinear Dropout DynamicQuantizeLinear Einsum Elu Erf"
    " Exp EyeLike GatherElements GatherND Gelu GlobalAveragePool GlobalLpPool GlobalMaxPool GridSample"
    " GroupNormalization HardSigmoid HardSwish Hardmax InstanceNormalization IsInf IsNaN LRN LayerNormalization"
    " LeakyRelu Log LogSoftmax LpNormalization Mean MeanVarianceNormalization Mish OneHot PRelu Pad Pow"
    " QuantizeLinear RMSNormalization Reciprocal ReduceL1 ReduceL2 ReduceLogSum ReduceLogSumExp ReduceMean"
    " ReduceSumSquare Relu Resize ReverseSequence Scatter ScatterElements Selu Shape Shrink Sigmoid Sign Sin Sinh Size"
    " Softmax Softplus Softsign SpaceToDepth Sum Swish Tan Tanh ThresholdedRelu TopK Trilu Upsample"
)
"""Operators of the default domain whose time is bounded by the sizes of their tensors."""
NESTED = (AttributeProto.GRAPH, AttributeProto.GRAPHS)
SPARSE = (AttributeProto.SPARSE_TENSOR, AttributeProto.SPARSE_TENSORS)


def largest_batch(spaces: AgentInterface) -> int:
    """Return how many observations a request to a server may have."""
    leaves = inputs(spaces.observation).values()
    largest = max(prod(leaf.shape) * np.dtype(leaf.dtype).itemsize for leaf in leaves)
    return max(1, min(MAX_BATCH, MAX_DECODED_BYTES // max(1, largest)))


def bounded(model: onnx.ModelProto, mapping: GraphMapping, spaces: AgentInterface, source: str) -> onnx.ModelProto:
    """Return a model without local functions, whose time and memory are bounded.

    Args:
        model: The model. `adapted_graph.check` accepts it.
        mapping: Of its inputs.
        spaces: Spaces of the policy.
        source: Identifies the model in messages.

    Raises:
        InvalidInput: Time or memory are not bounded, or too large. The message names operator and node.
    """
    _check_count(model, source)
    flat = onnx.inliner.inline_local_functions(model) if model.functions else model
    for node in flat.graph.node:
        where = f"{source}: {_described(node)}"
        if node.domain not in ("", "ai.onnx"):
            raise InvalidInput(f"{where} is of the domain {node.domain}: only operators of ONNX itself are supported")
        if node.op_type not in ALLOWED:
            raise InvalidInput(
                f"{where} is not supported: its time or memory is not bounded by the shapes of its inputs"
            )
        if any(attribute.type in SPARSE for attribute in node.attribute):
            raise InvalidInput(f"{where} has a sparse tensor, which is not supported")
        if node.op_type == "Einsum" and len(node.input) > 2:
            raise InvalidInput(f"{where} has {len(node.input)} inputs, expected at most 2")
    if flat.graph.sparse_initializer:
        raise InvalidInput(f"{source}: sparse weights are not supported")
    attributes = [attribute for node in flat.graph.node for attribute in node.attribute]
    constants = [weight for attribute in attributes for weight in (attribute.t, *attribute.tensors)]
    for weight in (*flat.graph.initializer, *constants):
        if weight.data_location == TensorProto.EXTERNAL:
            raise InvalidInput(f"{source}: {weight.name} is in another file that could not be included")
    graph, largest = _BoundedGraph(flat, _input_shapes(flat, mapping, spaces), source), largest_batch(spaces)
    last, before, one = (graph.check(rows) for rows in (largest, max(1, largest - 1), 1))
    if not all(_increases(node, one, before, last) for node in flat.graph.node):
        for rows in range(2, largest - 1):
            graph.check(rows)
    return flat


def _input_shapes(
    model: onnx.ModelProto, mapping: GraphMapping, spaces: AgentInterface
) -> dict[str, tuple[int | None, ...]]:
    """Return input → shape, in which only the batch is None. What a graph leaves open of an observation is known."""
    leaves, shapes = inputs(spaces.observation), {name: shape for name, (_, shape) in graph_inputs(model).items()}
    for name, input_mapping in mapping.inputs.items():
        if None in shapes[name][1:]:
            shapes[name] = (None, *input_mapping.shape(leaves[input_mapping.name].shape))
    return shapes


class _CheckedBatch(NamedTuple):
    """What is known about the tensors of a graph for one size of the batch."""

    shapes: dict[str, Shape]
    values: dict[str, NDArray]
    """Of small tensors that depend on weights and shapes only."""


class _BoundedGraph:
    """The nodes of a model, with what is known about them. shapes: see `_input_shapes`."""

    def __init__(self, model: onnx.ModelProto, shapes: Mapping[str, tuple[int | None, ...]], source: str) -> None:
        self._nodes, self._source, self._ir_version = list(model.graph.node), source, model.ir_version
        self._opsets = list(model.opset_import)
        self._version = next((opset.version for opset in self._opsets if opset.domain in ("", "ai.onnx")), 1)
        self._types: dict[str, TypeProto] = {}
        self._values: dict[str, NDArray] = {}
        for weight in model.graph.initializer:
            self._types[weight.name] = helper.make_tensor_type_proto(weight.data_type, list(weight.dims))
            if prod(weight.dims) <= KNOWN:
                self._values[weight.name] = numpy_helper.to_array(weight)
        self._given = {
            graph_input.name: (graph_input.type.tensor_type.elem_type, shapes[graph_input.name])
            for graph_input in model.graph.input
            if graph_input.name not in self._types
        }
        self._last_use = {name: at for at, node in enumerate(self._nodes) for name in (*node.output, *node.input)}
        self._last_use |= {result.name: len(self._nodes) for result in model.graph.output}
        self._sessions: dict[int, Any] = {}
        """Position of a node → what computes its result."""

    def check(self, rows: int) -> "_CheckedBatch":
        """Check a batch of this size. Raises InvalidInput."""
        types, values = dict(self._types), dict(self._values)
        for name, (kind, shape) in self._given.items():
            types[name] = helper.make_tensor_type_proto(kind, [rows if size is None else size for size in shape])
        living = {name: _bytes(types[name]) for name in self._given}
        for position, node in enumerate(self._nodes):
            types |= self._infer(node, types, values)
            living |= {name: _bytes(types[name]) for name in node.output if name}
            work, buffer = _work(node, types)
            costs = [
                (f"bytes of {name} {list(_shape(types[name]))}", _bytes(types[name]), MAX_TENSOR)
                for name in node.output
                if name
            ]
            # What is needed during the node or after it.
            in_use = sum(living.values()) + 4 * buffer
            costs += [("operations", work, MAX_OPERATIONS), ("bytes in use", in_use, MAX_MEMORY)]
            for cost, size, most in costs:
                if size > most:
                    raise InvalidInput(
                        f"{self._of(node)}: {size} {cost} for a batch of {rows} observations, expected at most {most}"
                    )
            for name in (*node.input, *node.output):
                if self._last_use.get(name) == position:
                    living.pop(name, None)
            if node.op_type in ("Shape", "Size") or all(name in values for name in node.input if name):
                values |= self._computed(position, node, types, values)
        return _CheckedBatch({name: _shape(kind) for name, kind in types.items()}, values)

    def _infer(
        self, node: NodeProto, types: Mapping[str, TypeProto], values: Mapping[str, NDArray]
    ) -> dict[str, TypeProto]:
        """Types of the outputs of a node, with a known shape."""
        names = [name for name in node.input if name]
        try:
            outputs = shape_inference.infer_node_outputs(
                onnx.defs.get_schema(node.op_type, self._version, ""),
                node,
                {name: types[name] for name in names},
                {name: numpy_helper.from_array(values[name], name) for name in names if name in values},
                opset_imports=self._opsets,
                ir_version=self._ir_version,
            )
        except Exception as error:
            raise InvalidInput(f"{self._of(node)}: {one_line(error)[:200]}") from error
        for name in filter(None, node.output):
            kind = outputs[name].tensor_type if name in outputs else None
            sizes = kind.shape.dim if kind is not None and kind.HasField("shape") else [None]
            if not all(size is not None and size.HasField("dim_value") and size.dim_value >= 0 for size in sizes):
                raise InvalidInput(
                    f"{self._of(node)}: the size of {name} depends on values, expected that it depends on shapes only"
                )
        return outputs

    def _computed(
        self, position: int, node: NodeProto, types: Mapping[str, TypeProto], values: Mapping[str, NDArray]
    ) -> dict[str, NDArray]:
        """The values of the outputs of a node, if they may be sizes."""
        names = list(filter(None, node.output))
        if node.op_type == "Shape":
            first, last = (_attribute(node, name) for name in ("start", "end"))
            return {names[0]: np.array(_shape(types[node.input[0]])[slice(first, last)], np.int64)}
        if node.op_type == "Size":
            return {names[0]: np.array(prod(_shape(types[node.input[0]])), np.int64)}
        if node.op_type not in COMPUTED or any(prod(_shape(types[name])) > KNOWN for name in names):
            return {}
        try:
            if position not in self._sessions:
                self._sessions[position] = self._session(node, types)
            feed = {name: values[name] for name in node.input if name}
            return dict(zip(names, self._sessions[position].run(names, feed), strict=True))
        except Exception as error:
            raise InvalidInput(f"{self._of(node)}: {one_line(error)[:200]}") from error

    def _session(self, node: NodeProto, types: Mapping[str, TypeProto]) -> Any:
        def free(names: Iterable[str]) -> list[onnx.ValueInfoProto]:
            kinds = {name: types[name].tensor_type for name in names if name}
            return [
                helper.make_tensor_value_info(name, kind.elem_type, [None] * len(kind.shape.dim))
                for name, kind in kinds.items()
            ]

        graph = helper.make_graph([node], "node", free(node.input), free(node.output))
        model = helper.make_model(graph, opset_imports=self._opsets, ir_version=self._ir_version)
        return open_session(model.SerializeToString())

    def _of(self, node: NodeProto) -> str:
        return f"{self._source}: {_described(node)}"


def _increases(node: NodeProto, one: _CheckedBatch, before: _CheckedBatch, last: _CheckedBatch) -> bool:
    """Whether sizes of a node do not decrease with the batch, if those before the node do not.

    Args:
        node: The node.
        one: A batch of one observation.
        before: The second largest batch. What equals that in the largest is constant.
        last: The largest batch.
    """
    for name in filter(None, node.output):
        shapes = (one.shapes[name], before.shapes[name], last.shapes[name])
        if len(set(map(len, shapes))) > 1 or not all(a <= b <= c for a, b, c in zip(*shapes, strict=True)):
            return False
        if name in last.values and not _is_sorted([batch.values.get(name) for batch in (one, before, last)]):
            return False
    changing = [
        name
        for name in node.input
        if name in last.values and not np.array_equal(last.values[name], before.values[name])
    ]
    if changing and node.op_type in ("Add", "Mul"):
        return all((one.values[name] >= 0).all() for name in node.input)
    if changing and node.op_type in COMPUTED:
        first = node.input[0]
        is_fixed = changing == [first] and last.shapes[first] == before.shapes[first]
        return node.op_type in SMOOTH or (node.op_type in ("Gather", "Slice", "Split") and is_fixed)
    if node.op_type in RESIZING:
        size_pairs = zip(before.shapes[node.input[0]], last.shapes[node.input[0]], strict=True)
        fixed = [a == b for a, b in size_pairs]
        results = [last.shapes[name] for name in node.output if name]
        return not changing and all(
            same or size == result
            for shape in results
            for same, size, result in zip(fixed, last.shapes[node.input[0]], shape, strict=False)
        )
    return True


def _is_sorted(values: list[NDArray | None]) -> bool:
    """Whether no element decreases from one array to the next. Arrays whose length changes are not compared."""
    arrays = [value for value in values if value is not None]
    if len({array.shape for array in arrays}) != 1 or arrays[0].dtype.kind == "b":
        return len(arrays) == len(values)
    return all(bool((a <= b).all()) for a, b in pairwise(arrays))


def _work(node: NodeProto, types: Mapping[str, TypeProto]) -> tuple[int, int]:
    """Operations of a node, each about as long as a multiplication, and the elements of its buffer."""
    input_shapes = [_shape(types[name]) if name else () for name in node.input]
    kind, result = node.op_type, _shape(types[next(filter(None, node.output))])
    if kind in PRODUCTS:
        right = input_shapes[3] if kind == "QLinearMatMul" else input_shapes[1]
        columns = bool(_attribute(node, "transB")) or len(right) == 1
        return prod(result) * right[-1 if columns else -2], 0
    if kind in CONVOLUTIONS:
        weights = input_shapes[3] if kind == "QLinearConv" else input_shapes[1]
        outer = input_shapes[0] if kind == "ConvTranspose" else result
        return prod(outer) * prod(weights[1:]), prod(weights[1:]) * prod(outer[2:])
    if kind in POOLS:
        return prod(result) * prod(_attribute(node, "kernel_shape") or ()), 0
    if kind in RECURRENT:
        sequence, weights, recurrent = input_shapes[:3]
        sums = sequence[0] * sequence[1] * weights[0] * weights[1]
        return sums * (weights[2] + recurrent[2]), sums
    if kind == "Einsum":
        return prod(_letters(node, input_shapes).values()), 0
    passes = int(_attribute(node, "size")) if kind == "LRN" else 64
    return passes * (prod(result) + sum(map(prod, input_shapes))), 0


def _letters(node: NodeProto, given: list[Shape]) -> dict[str, int]:
    """Letter of an Einsum's equation → size. An ellipsis stands for the axes that have no letter."""
    equation = (_attribute(node, "equation") or b"").decode().replace(" ", "")
    sizes: dict[str, int] = {}
    for term, shape in zip(equation.partition("->")[0].split(","), given, strict=True):
        before, dots, after = term.partition("...")
        hidden = [f"...{axis}" for axis in range(len(shape) - len(before) - len(after))] if dots else []
        for letter, size in zip([*before, *hidden, *after], shape, strict=True):
            sizes[letter] = max(size, sizes.get(letter, 1))
    return sizes


def _check_count(model: onnx.ModelProto, source: str) -> None:
    """Raise InvalidInput if inlining functions gives too many nodes, or does not end."""
    functions = {(function.domain, function.name, function.overload): function for function in model.functions}
    counts: dict[tuple[str, str, str], int | None] = {}

    def count(nodes: Iterable[NodeProto]) -> int:
        total = 0
        for node in nodes:
            if nested := [attribute for attribute in node.attribute if attribute.type in NESTED]:
                raise InvalidInput(
                    f"{source}: {_described(node)} has a graph of its own, {nested[0].name}: loops and branches are "
                    "not supported"
                )
            key = (node.domain, node.op_type, node.overload)
            total += counted(key) if key in functions else 1
            if total > MAX_NODES:
                raise InvalidInput(f"{source}: the graph has more than {MAX_NODES} nodes")
        return total

    def counted(key: tuple[str, str, str]) -> int:
        if key not in counts:
            counts[key] = None
            counts[key] = count(functions[key].node)
        total = counts[key]
        if total is None:
            raise InvalidInput(f"{source}: function {key[1]} calls itself")
        return total

    count(model.graph.node)


def _attribute(node: NodeProto, name: str) -> Any:
    return next((helper.get_attribute_value(attribute) for attribute in node.attribute if attribute.name == name), None)


def _described(node: NodeProto) -> str:
    """Operator and name of a node; without a name, its first output identifies it."""
    name = node.name or next(iter(node.output), "")
    return f"operator {node.op_type} of node {name!r}"


def _shape(kind: TypeProto) -> Shape:
    return tuple(size.dim_value for size in kind.tensor_type.shape.dim)


def _bytes(kind: TypeProto) -> int:
    dtype = helper.tensor_dtype_to_np_dtype(kind.tensor_type.elem_type)
    return prod(_shape(kind)) * np.dtype(dtype).itemsize
