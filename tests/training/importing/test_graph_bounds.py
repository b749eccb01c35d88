"""Time and memory of foreign graphs are bounded before anything runs them; usual networks are accepted."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from onnx import GraphProto, ModelProto, NodeProto, TensorProto, helper, numpy_helper
from torch import Tensor, nn

from league.errors import InvalidInput
from league.interface import AgentInterface, Interface
from league.spaces import Box, Discrete
from training.export.onnx_export import quiet
from training.importing import graph_bounds
from training.importing.graph_bounds import bounded
from training.importing.graph_mapping import GraphMapping
from training.importing.open_source import open_sources

MAPPING = GraphMapping(inputs={"planes": {"name": "observation"}}, output="policy_head", kind="logits")
HUGE = 10**12
node = helper.make_node


def spaces(*shape: int) -> AgentInterface:
    return AgentInterface(observation=Box(dtype="float32", shape=shape, low=-9, high=9), action=Discrete(n=5))


def info(name: str, *shape: Any, kind: int = TensorProto.FLOAT) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, kind, shape)


def model(nodes: Sequence[NodeProto], domains: Sequence[str] = (), functions: Sequence[Any] = ()) -> ModelProto:
    """`nodes` and a linear map from `planes` (N, 6) to `policy_head` (N, 5), which adds `extra` if there is one."""
    constants = {
        "w": np.ones((6, 5), np.float32), "zero": np.int64(0), "one": np.int64(1), "two": np.int64(2),
        "first": np.array([0], np.int64), "second": np.array([1], np.int64), "half": np.array([0.5, 0.5], np.float32),
        "huge": np.array([HUGE], np.int64), "both": np.array([0, 1], np.int64), "yes": np.array(True),
        "three": np.array([3], np.int64),
        "minus": np.array([-5], np.int64), "many": np.array([HUGE], np.int64), "row": np.ones(6, np.float32),
        "never": np.int64(2**62),
    }  # fmt: skip
    nodes = [node("Identity", ["planes"], ["seen"]), *nodes, node("MatMul", ["seen", "w"], ["policy_head"])]
    used = {name for operation in nodes for name in operation.input}
    weights = [numpy_helper.from_array(value, name) for name, value in constants.items() if name in used]
    graph = helper.make_graph(nodes, "foreign", [info("planes", "N", 6)], [info("policy_head", "N", 5)], weights)
    opsets = [helper.make_opsetid(domain, 18 if not domain else 1) for domain in ("", *domains)]
    return helper.make_model(graph, opset_imports=opsets, ir_version=10, functions=functions)


def body() -> GraphProto:
    """Of a loop: counts."""
    nodes = [node("Identity", ["on"], ["still"]), node("Add", ["count", "step"], ["next"])]
    inputs = [info("i", kind=TensorProto.INT64), info("on", kind=TensorProto.BOOL), info("count")]
    results = [info("still", kind=TensorProto.BOOL), info("next")]
    return helper.make_graph(nodes, "body", inputs, results, [numpy_helper.from_array(np.float32(1), "step")])


LARGEST = [
    node("ReduceMax", ["planes"], ["largest"], keepdims=0),
    node("Cast", ["largest"], ["number"], to=TensorProto.INT64),
    node("Unsqueeze", ["number", "first"], ["numbers"]),
]
"""`numbers`: an integer from the observations, (1,)."""
ROWS = [node("Shape", ["planes"], ["shape"]), node("Gather", ["shape", "first"], ["rows"])]
"""`rows`: the size of the batch, (1,)."""
LOOP = [
    node("Equal", ["number", "two"], ["on"]),
    node("Loop", ["never", "on", "largest"], ["end"], "endless", body=body()),
]
BRANCH = helper.make_graph([node("Identity", ["planes"], ["same"])], "branch", [], [info("same", "N", 6)])


def function(name: str, nodes: Sequence[NodeProto]) -> Any:
    opsets = [helper.make_opsetid("", 18), helper.make_opsetid("own", 1)]
    return helper.make_function("own", name, ["x"], ["y"], nodes, opsets)


def calls(names: Sequence[str]) -> list[NodeProto]:
    values = ["x", *(f"v{number}" for number in range(len(names) - 1)), "y"]
    return [
        helper.make_node(name, [value], [after], domain="own")
        for name, value, after in zip(names, values, values[1:], strict=False)
    ]


CALL = [helper.make_node("f0", ["planes"], ["called"], domain="own")]
DOUBLING = [function(f"f{depth}", calls([f"f{depth + 1}"] * 2)) for depth in range(60)]
ATTACKS: dict[str, tuple[ModelProto, str]] = {
    "loop": (model([*LARGEST, *LOOP]), "operator Loop of node 'endless' has a graph of its own"),
    "branch": (model([node("If", ["yes"], ["x"], then_branch=BRANCH, else_branch=BRANCH)]), "operator If of node 'x'"),
    "loop in a function": (
        model(CALL, ["own"], [function("f0", [node("Loop", ["", "", "x"], ["y"], body=body())])]),
        "operator Loop of node 'y' has a graph of its own",
    ),
    "recursion": (model(CALL, ["own"], [function("f0", calls(["f0"]))]), "function f0 calls itself"),
    "doubling functions": (
        model(CALL, ["own"], [*DOUBLING, function("f60", [node("Neg", ["x"], ["y"])])]),
        "the graph has more than 20000 nodes",
    ),
    "unknown function": (model(CALL, ["own"]), "operator f0 of node 'called' is of the domain own"),
    "another domain": (
        model([helper.make_node("FusedMatMul", ["seen", "w"], ["x"], domain="com.microsoft")], ["com.microsoft"]),
        "operator FusedMatMul of node 'x' is of the domain com.microsoft",
    ),
    "random": (model([node("RandomNormalLike", ["seen"], ["x"])]), "operator RandomNormalLike of node 'x' is not su"),
    "sequence": (model([node("SequenceConstruct", ["seen"], ["x"])]), "operator SequenceConstruct .* is not supported"),
    "non-zero": (model([node("NonZero", ["seen"], ["x"])]), "operator NonZero of node 'x' is not supported"),
    "compress": (model([node("Compress", ["row", "yes"], ["x"])]), "operator Compress .* is not supported"),
    "unique": (model([node("Unique", ["seen"], ["x"])]), "operator Unique .* is not supported"),
    "many operands": (model([node("Einsum", ["row"] * 3, ["x"], equation="i,j,k->ijk")]), "Einsum .* has 3 inputs"),
    "large constant": (model([node("ConstantOfShape", ["huge"], ["x"])]), "of node 'x': .* bytes of x .*, expected at"),
    "large range": (model([node("Range", ["zero", "never", "one"], ["x"])]), "operator Range .* bytes of x"),
    "large expansion": (model([node("Expand", ["one", "huge"], ["x"])]), "operator Expand of node 'x': .* bytes of x"),
    "large window": (
        model([node("Unsqueeze", ["seen", "both"], ["x"]),
               node("AveragePool", ["x"], ["y"], "mean", kernel_shape=[10**5, 10**5], pads=[10**5 - 1] * 4)]),
        "operator AveragePool of node 'mean': ",
    ),
    "large step": (
        model([node("MatMul", ["seen", "w"], ["a"]), node("Flatten", ["a"], ["b"], axis=0),
               node("Transpose", ["b"], ["c"]), node("MatMul", ["c", "b"], ["d"], "outer"),
               node("MatMul", ["d", "d"], ["e"], "cube")]),
        r"operator MatMul of node 'cube': \d+ operations for a batch of 1024",
    ),
    "many at once": (
        model([node("Flatten", ["seen"], ["b"], axis=0), node("Transpose", ["b"], ["c"]),
               *(node("Mul", ["b", "c"], [f"d{number}"]) for number in range(20)),
               node("Sum", [f"d{number}" for number in range(20)], ["e"])]),
        r"operator Mul of node 'd\d+': \d+ bytes in use",
    ),
    "only with three observations": (
        model([*ROWS, node("Equal", ["rows", "three"], ["is"]), node("Cast", ["is"], ["as"], to=TensorProto.INT64),
               node("Mul", ["as", "huge"], ["size"]), node("ConstantOfShape", ["size"], ["x"])]),
        "operator ConstantOfShape of node 'x': .* for a batch of 3 observations",
    ),
    "only with few observations": (
        model([node("Slice", ["seen", "second", "many"], ["others"]),
               node("Slice", ["others", "minus", "three", "first"], ["some"]), node("Flatten", ["some"], ["a"], axis=0),
               node("Concat", ["second", "huge"], ["times"], axis=0), node("Tile", ["a", "times"], ["x"])]),
        "operator Tile of node 'x': .* for a batch of [2-8] observations",
    ),
}  # fmt: skip
BY_VALUE: dict[str, list[NodeProto]] = {
    "Expand": [node("Expand", ["one", "numbers"], ["x"])],
    "Tile": [node("Tile", ["row", "numbers"], ["x"])],
    "ConstantOfShape": [node("ConstantOfShape", ["numbers"], ["x"])],
    "Range": [node("Range", ["zero", "number", "one"], ["x"])],
    "Reshape": [node("Concat", ["numbers", "first"], ["to"], axis=0), node("Reshape", ["seen", "to"], ["x"])],
    "OneHot": [node("OneHot", ["first", "number", "half"], ["x"])],
    "Pad": [node("Concat", ["first", "numbers"], ["to"], axis=0), node("Pad", ["row", "to"], ["x"])],
    "TopK": [node("TopK", ["seen", "numbers"], ["x", "places"])],
    "Slice": [node("Slice", ["row", "first", "numbers"], ["x"])],
    "Resize": [
        node("Cast", ["numbers"], ["scale"], to=TensorProto.FLOAT),
        node("Resize", ["row", "", "scale"], ["x"]),
    ],
}


@pytest.mark.parametrize("attack", ATTACKS)
def test_a_graph_without_bounds_is_refused(attack: str) -> None:
    graph, message = ATTACKS[attack]
    with pytest.raises(InvalidInput, match=f"^a.onnx: .*{message}") as refusal:
        bounded(graph, MAPPING, spaces(6), "a.onnx")
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("operator", BY_VALUE)
def test_a_size_that_depends_on_values_is_refused(operator: str) -> None:
    graph = model([*LARGEST, *BY_VALUE[operator]])
    onnx.checker.check_model(graph)
    with pytest.raises(InvalidInput, match=f"a.onnx: operator {operator} of node 'x': the size of x depends on values"):
        bounded(graph, MAPPING, spaces(6), "a.onnx")


@pytest.fixture
def interface() -> Interface:
    return Interface(agents={"agent": spaces(6)}, policies={"agent": "shared"}, sides={"agent": ("agent",)})


def test_an_endless_loop_is_not_imported(tmp_path: Path, interface: Interface) -> None:
    """It ends for all observations in play: their largest number is never 2."""
    path = tmp_path / "endless.onnx"
    path.write_bytes(model([*LARGEST, *LOOP]).SerializeToString())
    with pytest.raises(InvalidInput, match=r"endless.onnx: operator Loop of node 'endless' has a graph of its own"):
        open_sources(path, interface)


def test_weights_outside_of_the_directory_are_not_read(tmp_path: Path, interface: Interface) -> None:
    (tmp_path / "secret").write_bytes(bytes(120))
    (tmp_path / "models").mkdir()
    path = tmp_path / "models" / "a.onnx"
    (path.parent / "link").symlink_to(tmp_path / "secret")
    for location in ("../secret", str(tmp_path / "secret"), "link"):
        graph = model([])
        weight = next(tensor for tensor in graph.graph.initializer if tensor.name == "w")
        weight.ClearField("raw_data")
        weight.data_location = TensorProto.EXTERNAL
        weight.external_data.add(key="location", value=location)
        path.write_bytes(graph.SerializeToString())
        with pytest.raises(InvalidInput, match=r"a.onnx: not an ONNX model"):
            open_sources(path, interface)


def test_sparse_weights_are_refused() -> None:
    graph = model([])
    values, places = (numpy_helper.from_array(np.array([1], kind), "s") for kind in (np.float32, np.int64))
    graph.graph.sparse_initializer.append(helper.make_sparse_tensor(values, places, [HUGE]))
    with pytest.raises(InvalidInput, match="sparse weights are not supported"):
        bounded(graph, MAPPING, spaces(6), "a.onnx")


class Residual(nn.Module):
    def __init__(self, filters: int) -> None:
        super().__init__()
        self.first, self.second = (nn.Conv2d(filters, filters, 3, padding=1) for _ in range(2))
        self.norms = nn.ModuleList(nn.BatchNorm2d(filters) for _ in range(2))

    def forward(self, x: Tensor) -> Tensor:
        return torch.relu(x + self.norms[1](self.second(torch.relu(self.norms[0](self.first(x))))))


class Attending(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.encoder = nn.TransformerEncoder(nn.TransformerEncoderLayer(8, 2, 16, batch_first=True), 1)
        self.head = nn.Linear(8, 5)

    def forward(self, x: Tensor) -> Tensor:
        return self.head(self.encoder(x).mean(1))


class Remembering(nn.Module):
    def __init__(self, cell: type[nn.LSTM | nn.GRU]) -> None:
        super().__init__()
        self.cell, self.head = cell(8, 6, batch_first=True), nn.Linear(6, 5)

    def forward(self, x: Tensor) -> Tensor:
        return self.head(self.cell(x)[0][:, -1])


class Expanding(nn.Module):
    """Sizes are computed from the batch, in several ways."""

    def forward(self, x: Tensor) -> Tensor:
        rows = torch.arange(x.shape[0], device=x.device).unsqueeze(1).expand(-1, 5) * 0
        zeros = torch.zeros(x.shape[0], 5) + torch.ones(1, 5).repeat(x.shape[0], 1)
        return x.reshape(x.shape[0], -1)[:, :5] + rows + zeros + x.view(-1, 5).view(x.shape[0], -1)[:, :5]


NETWORKS: dict[str, tuple[nn.Module, tuple[int, ...]]] = {
    "of Atari": (
        nn.Sequential(nn.Conv2d(4, 32, 8, 4), nn.ReLU(), nn.Conv2d(32, 64, 4, 2), nn.ReLU(), nn.Conv2d(64, 64, 3),
                      nn.ReLU(), nn.Flatten(), nn.Linear(3136, 512), nn.ReLU(), nn.Linear(512, 5)),
        (4, 84, 84),
    ),
    "residual": (
        nn.Sequential(nn.Conv2d(2, 8, 3, padding=1), Residual(8), nn.Flatten(), nn.Linear(336, 5)), (2, 6, 7)
    ),
    "normalized": (
        nn.Sequential(nn.Conv2d(2, 8, 3), nn.GroupNorm(2, 8), nn.GELU(), nn.MaxPool2d(2), nn.AdaptiveAvgPool2d(1),
                      nn.Flatten(), nn.LayerNorm(8), nn.Linear(8, 5), nn.LogSoftmax(-1)),
        (2, 12, 12),
    ),
    "upsampling": (
        nn.Sequential(nn.Conv2d(2, 4, 3, padding=1), nn.Upsample(scale_factor=2), nn.PixelShuffle(2), nn.SiLU(),
                      nn.Flatten(), nn.Linear(672, 5)),
        (2, 6, 7),
    ),
    "attending": (Attending(), (9, 8)),
    "LSTM": (Remembering(nn.LSTM), (5, 8)),
    "GRU": (Remembering(nn.GRU), (5, 8)),
    "expanding": (Expanding(), (2, 5)),
}  # fmt: skip


def exported(network: nn.Module, shape: tuple[int, ...], opset: int | None) -> ModelProto:
    """opset: of the exporter that traces TorchScript; None: the exporter of programs."""
    example, names = (torch.zeros(2, *shape),), {"input_names": ["planes"], "output_names": ["policy_head"]}
    with quiet():
        if opset is None:
            sizes = ({0: torch.export.Dim("batch")},)
            program = torch.onnx.export(
                network.eval(), example, dynamo=True, dynamic_shapes=sizes, verbose=False, **names
            )
            assert program is not None
            return program.model_proto
        file, axes = io.BytesIO(), {"planes": {0: "batch"}, "policy_head": {0: "batch"}}
        torch.onnx.export(network.eval(), example, file, dynamo=False, opset_version=opset, dynamic_axes=axes, **names)
        return onnx.load_from_string(file.getvalue())


QUICK = {("residual", 17), ("GRU", 17)}
"""Of the exporter that traces TorchScript. Graphs of the other one: `tests/training/export/test_onnx_export.py`."""


@pytest.mark.parametrize(
    ("network", "opset"),
    [
        pytest.param(network, opset, marks=() if (network, opset) in QUICK else pytest.mark.slow)
        for network in NETWORKS
        for opset in (None, 17)
    ],
)
def test_networks_of_torch_are_accepted(network: str, opset: int | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also by the check of all batches."""
    module, shape = NETWORKS[network]
    graph = exported(module, shape, opset)
    flat = bounded(graph, MAPPING, spaces(*shape), "a.onnx")
    onnx.checker.check_model(flat)
    monkeypatch.setattr(graph_bounds, "MAX_BATCH", 8)
    monkeypatch.setattr(graph_bounds, "_increases", lambda *_: False)
    bounded(graph, MAPPING, spaces(*shape), "a.onnx")
