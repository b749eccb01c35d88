from typing import Any

import numpy as np
import pytest

from evaluation.playback.captions import Captions
from evaluation.playback.single_game import GameStep, Move
from league.interface import AgentInterface, Interface
from league.spaces import Box, Discrete, MultiDiscrete, Space

OBSERVATION = Box(dtype="float32", shape=(2,), low=None, high=None)


def interface(agents: int, action: Space, policies: int = 1) -> Interface:
    names = [f"agent_{i}" for i in range(agents)]
    return Interface(
        agents=dict.fromkeys(names, AgentInterface(observation=OBSERVATION, action=action)),
        policies={name: f"policy_{i % policies}" for i, name in enumerate(names)},
        sides={name: (name,) for name in names},
    )


def captions(league_interface: Interface, refs: int = 1) -> Captions:
    return Captions(
        "a game", league_interface, {agent: f"league@{i % refs}" for i, agent in enumerate(league_interface.agents)}
    )


def game_step(step: int, actions: dict[int, Any], agents: int, inputs: Any = None, is_over: bool = False) -> GameStep:
    dist_inputs = None if inputs is None else np.array(inputs, np.float32)
    moves = tuple(Move(f"agent_{i}", {}, action, dist_inputs) for i, action in actions.items())
    return GameStep(step, moves, (), {f"agent_{i}": float(i) for i in range(agents)}, is_over)


def test_an_agents_action_is_shown_until_its_next() -> None:
    caption = captions(interface(2, Discrete(n=3)), refs=2)
    assert [line.action for line in caption.of(game_step(0, {}, 2)).lines] == ["", ""]
    assert [(line.action, line.acted) for line in caption.of(game_step(1, {0: 2}, 2)).lines] == [
        ("2", True),
        ("", False),
    ]
    second = caption.of(game_step(2, {1: 1}, 2, is_over=True))
    assert [(line.action, line.acted) for line in second.lines] == [("2", False), ("1", True)]
    assert [(line.name, line.ref, line.color, line.value) for line in second.lines] == [
        ("agent_0", "league@0", 0, 0.0),
        ("agent_1", "league@1", 1, 1.0),
    ]
    assert (second.title, second.step) == ("a game", "step 2 · end")


def test_lines_have_the_colours_of_their_agents() -> None:
    two, many = interface(2, Discrete(n=3)), interface(8, Discrete(n=3), policies=2)
    shades = {f"agent_{i}": ("red", "gray")[i % 2] for i in range(8)}
    for league_interface, declared, expected in (
        (two, shades, ["red", "gray"]),
        (two, {"agent_0": "red"}, ["red", None]),
        (many, shades, ["red", "gray"]),
        (many, shades | {"agent_7": "blue"}, ["red", None]),
    ):
        drawn = Captions("a game", league_interface, dict.fromkeys(league_interface.agents, "league@1"), declared)
        assert [line.shade for line in drawn.of(game_step(0, {}, 8)).lines] == expected


def test_the_most_probable_actions_have_their_names_in_the_environment() -> None:
    caption = captions(interface(1, Discrete(n=4, start=5)))
    logits = np.log([0.1, 0.6, 0.05, 0.25])
    (line,) = caption.of(game_step(1, {0: 6}, 1, logits)).lines
    assert [action for action, _ in line.chances] == ["6", "8", "5"]
    assert [chance for _, chance in line.chances] == pytest.approx([0.6, 0.25, 0.1])


def test_each_element_of_an_action_has_its_probability() -> None:
    caption = captions(interface(1, MultiDiscrete(nvec=[2, 3], start=[0, 1], shape=(2,))))
    inputs = np.concatenate([np.log([0.2, 0.8]), np.log([0.5, 0.1, 0.4])])
    (line,) = caption.of(game_step(1, {0: [1, 1]}, 1, inputs)).lines
    assert line.action == "1 1"
    assert [action for action, _ in line.chances] == ["1", "1"]
    assert [chance for _, chance in line.chances] == pytest.approx([0.8, 0.5])


def test_continuous_actions_are_means() -> None:
    caption = captions(interface(1, Box(dtype="float32", shape=(6,), low=-1.0, high=1.0)))
    (line,) = caption.of(game_step(1, {0: [0.25, -1.0, 0, 0, 1, 1]}, 1, np.zeros(12))).lines
    assert (line.action, line.chances) == ("+0.25 -1.00 +0.00 +0.00 …", ())


def test_many_agents_share_a_line_by_policy_and_player() -> None:
    caption = captions(interface(20, Discrete(n=3), policies=2))
    first, second = caption.of(game_step(1, {i: (i // 2) % 5 // 4 for i in range(20)}, 20)).lines
    assert (first.name, second.name) == ("policy_0 (10 agents)", "policy_1 (10 agents)")
    assert first.action == ""
    assert first.chances == (("0", 0.8), ("1", 0.2))
    assert (first.value, second.value) == (9.0, 10.0)


def test_many_continuous_actions_have_a_mean() -> None:
    caption = captions(interface(20, Box(dtype="float32", shape=(1,), low=-1.0, high=1.0)))
    (line,) = caption.of(game_step(1, {i: [0.05 * i] for i in range(20)}, 20)).lines
    assert line.action == "mean +0.47"
