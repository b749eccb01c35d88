"""Versions with small handwritten graphs instead of trained ones.

Those of tic-tac-toe have a known strength. On each of the eight lines, a graph sees whether its own side or the
opponent has two marks, and prefers the squares of such lines over a fixed order of squares. `wins` and `blocks` select
which of the two it uses.
"""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from onnx import TensorProto, helper

from league.config.league import LeagueConfig
from league.environments.building import interface
from league.interface import AgentInterface
from league.registry.registry import Registry
from league.registry.storage.manifest import EXPLOITER, MAIN, Manifest
from league.registry.storage.rows import LeagueRow, VersionRow
from league.settings import Storage
from league.spaces import OBSERVATION, Box, Discrete, inputs
from tests.support.leagues.manifests import manifest, policy_manifest
from tests.support.policies.graphs import serialized, tensor

LEAGUE = "tictactoe"
LINES = ((0, 1, 2), (3, 4, 5), (6, 7, 8), (0, 3, 6), (1, 4, 7), (2, 5, 8), (0, 4, 8), (2, 4, 6))
CENTRE_FIRST = (4, 0, 2, 6, 8, 1, 3, 5, 7)
EDGES_FIRST = (1, 3, 5, 7, 8, 6, 2, 0, 4)


def config(**parts: object) -> LeagueConfig:
    document = {
        "league": LEAGUE,
        "environment": {"entry_point": "pettingzoo.classic.tictactoe_v3"},
        "play": {"opening_plies": 2},
    }
    gate = {"elo1": 100, "max_blocks": 300, "nights": None, "confirmation_blocks": 20}
    gate |= parts.pop("gate", {})  # type: ignore[arg-type]
    return LeagueConfig.from_mapping(document | parts | {"gate": gate})


def registry(home: Path, **parts: object) -> Registry:
    """A registry with the league, without versions."""
    league = config(**parts)
    opened = Registry.open(Storage.at(home))
    opened.leagues.register(league, interface(league))
    return opened


def publish(
    registry: Registry,
    graph: bytes,
    league: str = LEAGUE,
    exploits: str | None = None,
    source: str | None = None,
    settings: Mapping[str, object] | None = None,
    value: bytes | None = None,
) -> VersionRow:
    """Publish a version with one graph for all policies of the league.

    exploits: it is an exploiter of this version. source: by default a new one. settings: of its training. value: the
    second graph, with logits and value.
    """
    source = source or f"hand/{len(registry.versions.all(league))}"
    build = _builder(registry.leagues.get(league), graph, exploits, dict(settings or {}), value)
    return registry.publisher.publish(league, build, source=source, parent=None)


def linear(spaces: AgentInterface, seed: int = 0, memory: bool = False, chosen: NDArray | None = None) -> bytes:
    """A graph for vector observations: a linear map to the inputs of the distribution.

    chosen: its weights, (observations, inputs); by default they are random, with a random bias. memory: the graph
    counts its steps in its state, and its preferences change with them.
    """
    rng, width, outputs = np.random.default_rng(seed), inputs(spaces.observation)[OBSERVATION].shape[0], _logits(spaces)
    weights = {
        "weights": (rng.normal(size=(width, outputs)) if chosen is None else chosen).astype(np.float32),
        "bias": (rng.normal(size=outputs) if chosen is None else np.zeros(outputs)).astype(np.float32),
        "one": np.array(1, np.float32),
        "rates": np.arange(1, outputs + 1, dtype=np.float32)[None],
        "strength": np.array(20, np.float32),
    }
    graph_inputs, graph_outputs = [tensor(OBSERVATION, "float32", width)], []
    nodes = [
        helper.make_node("MatMul", [OBSERVATION, "weights"], ["seen"]),
        helper.make_node("Add", ["seen", "bias"], ["steady"]),
    ]
    if memory:
        graph_inputs.append(tensor("state_in_0", "float32", 1))
        graph_outputs.append(tensor("state_out_0", "float32", 1))
        nodes += [
            helper.make_node("Add", ["state_in_0", "one"], ["state_out_0"]),
            helper.make_node("MatMul", ["state_in_0", "rates"], ["angles"]),
            helper.make_node("Sin", ["angles"], ["turned"]),
            helper.make_node("Mul", ["turned", "strength"], ["turning"]),
            helper.make_node("Add", ["steady", "turning"], ["preferred"]),
        ]
    else:
        nodes.append(helper.make_node("Identity", ["steady"], ["preferred"]))
    if isinstance(spaces.action, Box):
        low, high = float(spaces.action.low), float(spaces.action.high)
        weights |= {"low": np.array(low, np.float32), "span": np.array(high - low, np.float32)}
        nodes += [
            helper.make_node("Sigmoid", ["preferred"], ["share"]),
            helper.make_node("Mul", ["share", "span"], ["above"]),
            helper.make_node("Add", ["above", "low"], ["action"]),
            helper.make_node("Concat", ["preferred", "preferred"], ["action_dist_inputs"], axis=1),
        ]
        graph_outputs = [
            tensor("action", "float32", outputs),
            tensor("action_dist_inputs", "float32", 2 * outputs),
            *graph_outputs,
        ]
    else:
        nodes += [
            helper.make_node("Identity", ["preferred"], ["action_dist_inputs"]),
            helper.make_node("ArgMax", ["preferred"], ["action"], axis=1, keepdims=0),
        ]
        graph_outputs = [tensor("action", "int64"), tensor("action_dist_inputs", "float32", outputs), *graph_outputs]
    return serialized(nodes, graph_inputs, graph_outputs, weights)


def chase_landmark(spaces: AgentInterface) -> bytes:
    """A graph for mpe2.simple that steers to the landmark. The observation is velocity and relative position, (x, y)
    each.
    """
    towards = np.zeros((4, 5))
    for axis in (0, 1):
        towards[2 + axis, [1 + 2 * axis, 2 + 2 * axis]] = -1.0, 1.0
        towards[axis, [1 + 2 * axis, 2 + 2 * axis]] = 0.4, -0.4
    return linear(spaces, chosen=towards)


def _logits(spaces: AgentInterface) -> int:
    match spaces.action:
        case Discrete(n=n):
            return n
        case Box(shape=(m,)):
            return m
    raise AssertionError(f"no linear graph for {spaces.action}")


def graph(
    wins: bool = False, blocks: bool = False, order: tuple[int, ...] = EDGES_FIRST, faulty: bool = False
) -> bytes:
    """An ONNX graph with the interface of a checkpoint: observation, action_mask → action, action_dist_inputs.

    faulty: it always regards the last square as free, and sometimes plays it although it is taken.
    """
    see = np.zeros((18, 16), np.float32)
    heed = np.zeros((16, 9), np.float32)
    for i, line in enumerate(LINES):
        for square in line:
            see[2 * square, i] = see[2 * square + 1, 8 + i] = 1.0
            heed[i, square] = 200.0 * wins
            heed[8 + i, square] = 20.0 * blocks
    weights = {
        "see": see,
        "more_than_one": np.full(16, -1.0, np.float32),
        "heed": heed,
        "order": -np.argsort(order).astype(np.float32),
        "flat": np.array([-1, 18], np.int64),
        "taken_for_free": np.arange(9) == (8 if faulty else 9),
        "illegal": np.array(np.finfo(np.float32).min, np.float32),
    }
    nodes = [
        helper.make_node("Cast", ["observation"], ["planes"], to=TensorProto.FLOAT),
        helper.make_node("Reshape", ["planes", "flat"], ["squares"]),
        helper.make_node("MatMul", ["squares", "see"], ["marks"]),
        helper.make_node("Add", ["marks", "more_than_one"], ["excess"]),
        helper.make_node("Relu", ["excess"], ["pairs"]),
        helper.make_node("MatMul", ["pairs", "heed"], ["urgent"]),
        helper.make_node("Add", ["urgent", "order"], ["wanted"]),
        helper.make_node("Cast", ["action_mask"], ["masked"], to=TensorProto.BOOL),
        helper.make_node("Or", ["masked", "taken_for_free"], ["legal"]),
        helper.make_node("Where", ["legal", "wanted", "illegal"], ["action_dist_inputs"]),
        helper.make_node("ArgMax", ["action_dist_inputs"], ["action"], axis=1, keepdims=0),
    ]
    graph_inputs = [tensor("observation", "int8", 3, 3, 2), tensor("action_mask", "int8", 9)]
    graph_outputs = [tensor("action", "int64"), tensor("action_dist_inputs", "float32", 9)]
    return serialized(nodes, graph_inputs, graph_outputs, weights)


def _builder(
    row: LeagueRow, graph: bytes, exploits: str | None, settings: dict[str, object], value: bytes | None
) -> Callable[[Path, int], Manifest]:
    def build(directory: Path, number: int) -> Manifest:
        policies = {}
        for name in row.interface.policy_ids:
            (directory / f"{name}.onnx").write_bytes(graph)
            if value is not None:
                (directory / f"{name}.value.onnx").write_bytes(value)
            files = {} if value is None else {"value": f"{name}.value.onnx"}
            policies[name] = policy_manifest(row.interface.of_policy(name), name, graph, **files)
        role = MAIN if exploits is None else EXPLOITER
        return manifest(row, number, policies, settings=settings, role=role, exploits=exploits)

    return build


def playable(registry: Registry) -> None:
    """A league that can be played, with two versions."""
    league = config(play={"opening_plies": 2, "num_envs": 2})
    registry.leagues.register(league, interface(league))
    for wins in (False, True):
        publish(registry, graph(wins=wins))
