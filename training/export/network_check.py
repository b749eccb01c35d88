"""Checks a network of the user's code before training: that it learns, and that its graph computes what it does."""

import logging
import re
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from io import StringIO
from itertools import count

import numpy as np
import onnxruntime
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from league.config.league import LeagueConfig
from league.errors import ConfigError, last_of_user, no_exit, one_line, raised_at
from league.interface import Interface
from league.policies.actions import to_environment
from league.random.seeds import derive, generator
from league.spaces import ACTION_MASK
from training.algorithms.rllib_config import module_spec
from training.export.onnx_export import onnx_program
from training.export.parity import TOLERANCE, ObservedBatch, PlayLimits, influence, observed_play
from training.modules.own_network import NETWORK, OwnNetwork
from training.sampling.distributions import distribution
from training.sampling.env_runner import one_thread
from training.sampling.reset_seeds import SEEDS

DRAWN = PlayLimits(observations=64, megabytes=64, enough_seconds=4.0, most_seconds=60.0, least=8)
FRAME = re.compile(r'File "([^"]+)", line (\d+)')


@one_thread()
def check_network(config: LeagueConfig, interface: Interface) -> None:
    """Check the network of each policy on observations from random play; nothing without `training.network`.

    Raises ConfigError, with the line of the network's code, if it raises, returns other features than it declares, or
    cannot be exported, or if its graph computes something else.
    """
    if config.training.network is None:
        return
    entry_point = config.training.network.entry_point
    modules = module_spec(config.training, interface).build()
    for policy, observations in _drawn(config, interface).items():
        network = modules[policy].encoder
        assert isinstance(network, OwnNetwork)
        inputs = {name: observations[name] for name in network.names}
        try:
            with no_exit:
                features = network({name: torch.from_numpy(array) for name, array in inputs.items()})
            problem = _problem(features, len(next(iter(inputs.values()))), network.width)
            if problem is None and features.requires_grad:
                features.sum().backward()
        except Exception as error:
            reason = one_line(error, with_type=True, first_line=True)
            raise _error(entry_point, raised_at(error) or _definition(network), f"raises {reason}") from error
        problem = problem or _difference(_graph(entry_point, network.eval(), inputs), network, inputs)
        if problem is not None:
            raise _error(entry_point, _definition(network), problem)


def _error(entry_point: str, line: str | None, problem: str) -> ConfigError:
    return ConfigError(f"{NETWORK}: {entry_point}{f' ({line})' if line else ''} {problem}")


def _definition(network: OwnNetwork) -> str | None:
    """Return the line where the user's code defines the network's forward pass, if it does."""
    code = getattr(type(network.network).forward, "__code__", None)
    return None if code is None else last_of_user([(code.co_filename, code.co_firstlineno)])


def _drawn(config: LeagueConfig, interface: Interface) -> dict[str, dict[str, NDArray]]:
    """Return policy id → observations of random play, ONNX input name → (k, …)."""
    rng, seed = generator(config.training.seed, "network"), config.training.seed
    actions = {policy: interface.of_policy(policy).action for policy in interface.policy_ids}

    def act(policy: str, observed: ObservedBatch, _plays: bool) -> tuple[NDArray, dict[str, NDArray]]:
        mask = observed.observations.get(ACTION_MASK)
        raw, _ = distribution(actions[policy]).uniform(mask, len(observed), rng)
        return to_environment(raw, actions[policy]), {}

    seeds = (derive(seed, "network", reset) % SEEDS for reset in count())
    stateless = {policy: dict[str, NDArray]() for policy in interface.policy_ids}
    play = observed_play(config.environment, interface, stateless, act, DRAWN, seeds)
    return {
        policy: {
            name: np.concatenate([batch.observations[name] for batch in batches]) for name in batches[0].observations
        }
        for policy, batches in play.items()
    }


def _problem(features: object, rows: int, width: int) -> str | None:
    """Return how features differ from what the network declares; None if they do not."""
    expected = f"expected float32 [{rows}, {width}], a row of its `width` for each observation"
    if not isinstance(features, Tensor):
        return f"returned a {type(features).__name__}: {expected}"
    if features.shape != (rows, width) or features.dtype != torch.float32:
        return f"returned {str(features.dtype).removeprefix('torch.')} {list(features.shape)}: {expected}"
    return None if features.isfinite().all() else "returned numbers that are not finite"


class _Features(nn.Module):
    """A network with positional inputs."""

    def __init__(self, network: OwnNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, *arrays: Tensor) -> Tensor:
        return self.network(dict(zip(self.network.names, arrays, strict=True)))


def _graph(entry_point: str, network: OwnNetwork, inputs: dict[str, NDArray]) -> bytes:
    """Return the ONNX graph of a network. Raises ConfigError, which names the line that ONNX cannot express."""
    examples = tuple(torch.from_numpy(array[:2]) for array in inputs.values())
    dynamic_shapes = (tuple({0: torch.export.Dim("batch")} for _ in examples),)
    program: torch.export.ExportedProgram | None = None
    with _without_output():
        try:
            program = torch.export.export(_Features(network), examples, dynamic_shapes=dynamic_shapes, strict=False)
            return onnx_program(program, (), list(network.names), ["features"]).model_proto.SerializeToString()
        except Exception as error:
            causes = _causes(error)
            line = _line(causes) if program is None else _unsupported_line(program, causes)
            reason = one_line(causes[0], with_type=True, first_line=True)
            raise _error(entry_point, line, f"cannot be exported to ONNX: {reason}") from error


def _causes(error: BaseException) -> list[BaseException]:
    """Return an error and its causes, the first cause first."""
    causes = [error]
    while (above := causes[0].__cause__) is not None:
        causes.insert(0, above)
    return causes


def _line(causes: Sequence[BaseException]) -> str | None:
    """Return the line of the user's code that tracebacks or messages of the exporter name."""
    texts = ("".join(traceback.format_exception(error, chain=False)) for error in causes)
    return next(filter(None, (last_of_user(FRAME.findall(text)) for text in texts)), None)


def _unsupported_line(program: torch.export.ExportedProgram, causes: Sequence[BaseException]) -> str | None:
    """Return the line of the user's code whose operator has no counterpart in ONNX."""
    messages = " ".join(map(str, causes))
    for node in program.run_decompositions().graph.nodes:
        if node.op == "call_function" and f"torch.ops.{node.target}]" in messages:
            return last_of_user(FRAME.findall(node.meta.get("stack_trace") or ""))
    return None


def _difference(graph: bytes, network: OwnNetwork, inputs: dict[str, NDArray]) -> str | None:
    """Return how the features of a graph differ from those of its network, or depend on more than the observation; None
    if neither is so.
    """
    session = onnxruntime.InferenceSession(graph, providers=["CPUExecutionProvider"])
    names, largest = [node.name for node in session.get_inputs()], 0.0
    for rows in (1, len(next(iter(inputs.values())))):
        batch = {name: array[:rows] for name, array in inputs.items()}
        with torch.no_grad():
            expected = network({name: torch.from_numpy(array) for name, array in batch.items()}).numpy()
        try:
            (features,) = session.run(None, {name: batch[name] for name in names})
        except Exception as error:
            return f"has an ONNX graph that fails for a batch of {rows}: {one_line(error, first_line=True)}"
        largest = max(largest, float((np.abs(features - expected) / (1 + np.abs(expected))).max(initial=0.0)))
    problem = influence(lambda arrays: session.run(None, {name: arrays[name] for name in names}), inputs)
    if problem is None and not largest <= TOLERANCE:
        problem = (
            f"differs from its ONNX graph by up to {largest:g}, relative to 1 + |x|, in a feature: features must be"
            " computed by torch, from the observations alone"
        )
    return problem


@contextmanager
def _without_output() -> Iterator[None]:
    """Suppress what torch prints and logs about code that it cannot trace: the error contains it."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
            yield
    finally:
        logging.disable(before)
