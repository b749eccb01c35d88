"""Exports a policy's module to ONNX: one self-contained file with everything needed to act, and one with its value."""

import logging
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from onnx.utils import Extractor
from ray.rllib.core.columns import Columns
from torch import Tensor, nn

from league.interface import AgentInterface
from league.policies.actions import dist_inputs_size
from league.policies.onnx import ACTION, DIST_INPUTS, LAST_ACTION, STATE_IN, STATE_OUT, VALUE
from league.registry.storage.manifest import Tensor as TensorManifest
from league.spaces import Box, DictSpace, Discrete, MultiDiscrete, Space, inputs
from league.spaces.arrays import bounds
from training.modules.actor_critic import ActorCritic
from training.modules.policy_module import PREVIOUS_ACTION, PolicyModule
from training.modules.value_function import ReturnNormalization

BATCH = "batch"


class PolicyGraph(nn.Module):
    """The exported module: observations, then states, as positional tensors → (`action`, `action_dist_inputs`, states).

    `action` is greedy and in the agent's action space; it is legal, since the distribution inputs are masked. With an
    ActorCritic without state, `has_value` adds `value` (B,). scale: its units.
    """

    def __init__(
        self,
        module: PolicyModule,
        observed: tuple[str, ...],
        action: Space,
        has_value: bool = False,
        scale: ReturnNormalization | None = None,
    ) -> None:
        super().__init__()
        self.module = module
        self.observed = observed
        self.remembered = tuple(module.get_initial_state())
        assert isinstance(action, Discrete | MultiDiscrete | Box), "module_spec refuses others"
        self.to_environment = ContinuousActions(action) if isinstance(action, Box) else IntegerActions(action)
        self.has_value = has_value
        self.deviation, self.mean = (1.0, 0.0) if scale is None else (scale.deviation, float(scale.mean))

    def forward(self, *arrays: Tensor) -> tuple[Tensor, ...]:
        observations = dict(zip(self.observed, arrays, strict=False))
        if self.has_value:
            assert isinstance(self.module, ActorCritic), "others have no value"
            embeddings = self.module.encoder(observations)
            answer: dict[str, Any] = self.module.policy_outputs(embeddings, observations)
            states = [self.module.compute_values({Columns.OBS: observations}, embeddings) * self.deviation + self.mean]
        else:
            state = dict(zip(self.remembered, arrays[len(self.observed) :], strict=True))
            answer = self.module.greedy_outputs({Columns.OBS: observations, Columns.STATE_IN: state})
            states = [answer[Columns.STATE_OUT][key] for key in self.remembered]
        dist_inputs = answer[Columns.ACTION_DIST_INPUTS]
        return self.to_environment(self.module.distribution.mode(dist_inputs)), dist_inputs, *states


class IntegerActions(nn.Module):
    """Maps raw integers to those of the space: see league/policies/actions.py."""

    start: Tensor

    def __init__(self, space: Discrete | MultiDiscrete) -> None:
        super().__init__()
        self.shape = space.shape
        self.dtype = _dtype(space.dtype)
        self.register_buffer("start", torch.as_tensor(np.asarray(space.start)))

    def forward(self, raw: Tensor) -> Tensor:
        return (raw.reshape(-1, *self.shape) + self.start).to(self.dtype)


class ContinuousActions(nn.Module):
    """Maps raw numbers into the bounds of the space: see league/policies/actions.py."""

    low: Tensor
    high: Tensor
    finite: Tensor

    def __init__(self, space: Box) -> None:
        super().__init__()
        self.shape = space.shape
        self.dtype = _dtype(space.dtype)
        largest = np.finfo(space.dtype).max
        low, high = (np.clip(bound, -largest, largest) for bound in bounds(space))
        finite = np.logical_and(*map(np.isfinite, bounds(space)))
        self.is_bounded, self.is_free = bool(finite.all()), not finite.any()
        self.register_buffer("low", torch.as_tensor(low))
        self.register_buffer("high", torch.as_tensor(high))
        self.register_buffer("finite", torch.as_tensor(finite))

    def forward(self, raw: Tensor) -> Tensor:
        raw = raw.reshape(-1, *self.shape).double()
        clipped = raw.clamp(self.low, self.high)
        if self.is_free:
            return clipped.to(self.dtype)
        share = (raw.clamp(-1.0, 1.0) + 1) / 2
        spanned = (self.low * (1 - share) + self.high * share).clamp(self.low, self.high)
        return (spanned if self.is_bounded else torch.where(self.finite, spanned, clipped)).to(self.dtype)


def export_policy(
    module: PolicyModule,
    spaces: AgentInterface,
    path: Path,
    value: Path | None = None,
    scale: ReturnNormalization | None = None,
) -> None:
    """Write the graph of `module` to `path`, with the tensors of `graph_tensors` and a dynamic batch size.

    value: where the graph from the same inputs to `action_dist_inputs` and `value` is written; None for no value.
    scale: the units in which `module` computes it; None for those of the rewards.
    """
    input_tensors, output_tensors, _ = graph_tensors(module, spaces)
    # Two rows: torch.export treats a batch of one as constant.
    examples = tuple(
        torch.zeros([size or 2 for size in tensor.shape], dtype=_dtype(tensor.dtype)) for tensor in input_tensors
    )
    graph = PolicyGraph(module, tuple(inputs(spaces.observation)), spaces.action, value is not None, scale).eval()
    input_names, output_names = ([tensor.name for tensor in tensors] for tensors in (input_tensors, output_tensors))
    dynamic_shapes = (tuple({0: torch.export.Dim(BATCH)} for _ in input_tensors),)
    if value is None:
        program = onnx_program(graph, examples, input_names, output_names, dynamic_shapes=dynamic_shapes)
        program.save(str(path), external_data=False)
        return
    # One export, which takes seconds, and two parts of it.
    program = onnx_program(graph, examples, input_names, [*output_names, VALUE], dynamic_shapes=dynamic_shapes)
    parts = Extractor(program.model_proto)
    path.write_bytes(parts.extract_model(input_names, output_names).SerializeToString())
    value.write_bytes(parts.extract_model(input_names, [DIST_INPUTS, VALUE]).SerializeToString())


def onnx_program(
    module: nn.Module | torch.export.ExportedProgram,
    examples: tuple[Tensor, ...],
    input_names: list[str],
    output_names: list[str],
    **options: Any,
) -> torch.onnx.ONNXProgram:
    """Convert a module to ONNX, without the exporter's messages. Raises what the exporter raises.

    Args:
        module: The module, or a program that was exported from it.
        examples: Its arguments.
        input_names: Names of the graph's inputs.
        output_names: Names of its outputs.
        options: Further arguments of `torch.onnx.export`.
    """
    with quiet():
        program = torch.onnx.export(
            module, examples, dynamo=True, input_names=input_names, output_names=output_names, verbose=False, **options
        )
    assert program is not None, "the exporter returns a program unless it is told to write one"
    return program


Tensors = tuple[TensorManifest, ...]


def graph_tensors(module: PolicyModule, spaces: AgentInterface) -> tuple[Tensors, Tensors, Tensors]:
    """Return inputs, outputs and recurrent inputs of a policy's graph for its manifest.

    The recurrent inputs are the last of the inputs.
    """
    assert not isinstance(spaces.action, DictSpace), "module_spec refuses it"
    observed = tuple(
        TensorManifest(name=name, dtype=leaf.dtype, shape=(None, *leaf.shape))
        for name, leaf in inputs(spaces.observation).items()
    )
    acted = (
        TensorManifest(name=ACTION, dtype=spaces.action.dtype, shape=(None, *spaces.action.shape)),
        TensorManifest(name=DIST_INPUTS, dtype="float32", shape=(None, dist_inputs_size(spaces.action))),
    )
    initial = module.get_initial_state()
    before, after = (
        tuple(
            TensorManifest(name=name, dtype=state.dtype.name, shape=(None, *state.shape))
            for name, state in zip(state_names(initial, prefix), initial.values(), strict=True)
        )
        for prefix in (STATE_IN, STATE_OUT)
    )
    return (*observed, *before), (*acted, *after), before


def state_names(keys: Iterable[str], prefix: str = STATE_IN) -> list[str]:
    """Map a module's state keys to the graph's: numbered, except for the previous action, which is LAST_ACTION."""
    return [
        prefix + (LAST_ACTION.removeprefix(STATE_IN) if key == PREVIOUS_ACTION else str(i))
        for i, key in enumerate(keys)
    ]


def _dtype(name: str) -> torch.dtype:
    return getattr(torch, name)


@contextmanager
def quiet() -> Iterator[None]:
    """Suppress the exporter's notes on optional packages and its own deprecation warnings."""
    exporter = logging.getLogger("torch.onnx")
    level = exporter.level
    exporter.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        exporter.setLevel(level)
