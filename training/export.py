"""RLModule → ONNX: one self-contained file that is all a policy needs to act."""

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.torch import TorchRLModule
from torch import Tensor, nn

from league.interface import AgentInterface
from league.policies.onnx import ACTION, DIST_INPUTS
from league.registry.manifest import Tensor as TensorManifest
from league.spaces import Discrete, inputs

BATCH = "batch"


class ActingGraph(nn.Module):
    """What is exported: observations, as positional tensors → (`action`, `action_dist_inputs`).

    `action` is greedy and in the agent's own action space; as the distribution's inputs are masked, it is legal.
    """

    def __init__(self, module: TorchRLModule, names: tuple[str, ...], first_action: int) -> None:
        super().__init__()
        self.module = module
        self.names = names
        self.first_action = first_action

    def forward(self, *observations: Tensor) -> tuple[Tensor, Tensor]:
        batch = {Columns.OBS: dict(zip(self.names, observations, strict=True))}
        dist_inputs = self.module._forward(batch)[Columns.ACTION_DIST_INPUTS]
        return dist_inputs.argmax(dim=-1) + self.first_action, dist_inputs


def export_policy(module: TorchRLModule, spaces: AgentInterface, path: Path) -> None:
    """Write the graph of `module` to `path`. Inputs and outputs are those of `graph_tensors`, the batch is dynamic."""
    assert isinstance(spaces.action, Discrete), f"no graph for actions {spaces.action}"
    leaves = inputs(spaces.observation)
    # Two rows: torch.export takes a batch of one for a constant.
    examples = tuple(torch.zeros((2, *leaf.shape), dtype=_dtype(leaf.dtype)) for leaf in leaves.values())
    graph = ActingGraph(module, tuple(leaves), spaces.action.start).eval()
    with _quiet():
        program = torch.onnx.export(
            graph,
            examples,
            dynamo=True,
            input_names=list(leaves),
            output_names=[ACTION, DIST_INPUTS],
            dynamic_shapes=(tuple({0: torch.export.Dim(BATCH)} for _ in leaves),),
            verbose=False,
        )
    assert program is not None, "the exporter returns a program unless it is told to write one"
    program.save(str(path), external_data=False)


def graph_tensors(spaces: AgentInterface) -> tuple[tuple[TensorManifest, ...], tuple[TensorManifest, ...]]:
    """Inputs and outputs of a policy's graph, as its manifest states them."""
    assert isinstance(spaces.action, Discrete)
    observed = tuple(
        TensorManifest(name=name, dtype=leaf.dtype, shape=(None, *leaf.shape))
        for name, leaf in inputs(spaces.observation).items()
    )
    answered = (
        TensorManifest(name=ACTION, dtype="int64", shape=(None,)),
        TensorManifest(name=DIST_INPUTS, dtype="float32", shape=(None, spaces.action.n)),
    )
    return observed, answered


def _dtype(name: str) -> torch.dtype:
    return getattr(torch, name)


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep the exporter's notes on optional packages and its own deprecations from the user's terminal."""
    exporter = logging.getLogger("torch.onnx")
    level = exporter.level
    exporter.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        exporter.setLevel(level)
