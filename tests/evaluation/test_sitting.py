"""A person's game is a function of its seed and choices, and the game that policies would have played."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper

from evaluation.exhibition import Moment, exhibit
from evaluation.sitting import PERSON, Sat, sit
from league.config import LeagueConfig
from league.environments.building import interface
from league.environments.lockstep import stepping
from league.environments.stepping import BatchedEnvironment
from league.errors import EnvironmentMismatch, GameCrashed, IllegalAction, InvalidInput
from league.games import Sitting
from league.interface import Interface
from league.policies.loading import contestant
from league.policies.onnx import OnnxPolicy
from league.policies.policy import Actions, Arrays, Policy
from league.spaces import inputs
from tests.evaluation import examples

TICTACTOE = "pettingzoo.classic.tictactoe_v3"
CONNECT_FOUR = "pettingzoo.classic.connect_four_v3"
SPREAD = "mpe2.simple_spread_v3"
BRIEF = {"max_cycles": 8}


@cache
def table(entry_point: str, **kwargs: Any) -> tuple[LeagueConfig, Interface, BatchedEnvironment]:
    """A league, and an environment that game after game is played in."""
    config = LeagueConfig.from_mapping(
        {"league": "home", "environment": {"entry_point": entry_point, "kwargs": dict(kwargs)}}
    )
    return config, interface(config), stepping(config.environment, 1)


def everybody(described: Interface, policy: Policy) -> dict[str, Policy]:
    return dict.fromkeys(described.agents, policy)


def scripted(described: Interface, name: str = "random") -> dict[str, Policy]:
    return {agent: policy for agent, (_, policy) in contestant(f"script:{name}", None, described).items()}


def ask(entry_point: str, players: Mapping[str, Policy], agent: str, actions: Sequence[int] = (), **asked: Any) -> Sat:
    kwargs = asked.pop("kwargs", {})
    config, described, environment = table(entry_point, **kwargs)
    sitting = Sitting(opponent="script:random", agent=agent, actions=tuple(actions), **asked)
    return sit(sitting, config, described, players, environment, draws=False)


class Scripted:
    """Chooses what a person has chosen."""

    def __init__(self, choices: Sequence[int]) -> None:
        self._choices = iter(choices)

    def act(self, observations: Arrays, *, state: Any = None, explore: bool = False, rng: Any = None) -> Actions:
        return Actions(np.array([next(self._choices)]))


def moves_of(moments: Sequence[Moment]) -> list[list[tuple[str, Any]]]:
    return [[(move.agent, move.action) for move in moment.moves] for moment in moments]


def moves_in(sat: Sat) -> list[list[tuple[str, Any]]]:
    return [[(move.agent, move.action) for move in step.moves] for step in sat.steps]


@pytest.mark.parametrize(("entry_point", "kwargs"), [(TICTACTOE, {}), (CONNECT_FOUR, {}), (SPREAD, BRIEF)])
@settings(max_examples=25)
@given(data=st.data())
def test_any_prefix_asked_again_is_the_same_game_which_is_the_one_that_policies_play(
    entry_point: str, kwargs: dict[str, Any], data: st.DataObject
) -> None:
    _, described, environment = table(entry_point, **kwargs)
    agent = data.draw(st.sampled_from(list(described.agents)))
    seed = data.draw(st.integers(0, 2**63 - 1))
    players, chosen = scripted(described), list[int]()
    so_far = [ask(entry_point, players, agent, seed=seed, kwargs=kwargs)]
    while not so_far[-1].over:
        chosen.append(data.draw(st.sampled_from(so_far[-1].legal)))
        so_far.append(ask(entry_point, players, agent, chosen, seed=seed, kwargs=kwargs))
    whole = so_far[-1]
    for number in data.draw(st.lists(st.integers(0, len(chosen)), max_size=4)):
        again = ask(entry_point, players, agent, chosen[:number], seed=seed, kwargs=kwargs)
        assert again == so_far[number]
        assert whole.steps[: len(again.steps)] == again.steps
    played = list(exhibit(environment, {**players, agent: Scripted(chosen)}, seed))
    assert moves_in(whole) == moves_of(played)
    assert whole.returns == played[-1].returns
    assert {move.ref for step in whole.steps for move in step.moves if move.agent == agent} == {PERSON}


@pytest.mark.parametrize("memory", [False, True], ids=["without memory", "with memory"])
def test_who_does_what_the_opponent_would_do_plays_the_opponents_game_with_itself(memory: bool) -> None:
    _, described, environment = table(SPREAD, **BRIEF)
    spaces = described.of_policy("shared")
    players = everybody(described, OnnxPolicy(examples.linear(spaces, seed=3, memory=memory)))
    chosen: list[int] = []
    while not (sat := ask(SPREAD, players, "agent_1", chosen, chances=True, kwargs=BRIEF)).over:
        assert sum(chance for _, chance in sat.chances) == pytest.approx(1, abs=1e-5)
        chosen.append(sat.chances[0][0])
    played = list(exhibit(environment, players, 0))
    assert moves_in(sat) == moves_of(played)
    assert len(set(chosen)) > 1 or not memory
    assert all(move.chances[0][0] == move.action for step in sat.steps for move in step.moves)


def following(width: int, actions: int) -> bytes:
    """A graph that remembers its last action, and prefers the next one."""
    nodes = [
        helper.make_node("Mod", ["state_in_action", "count"], ["next"], fmod=1),
        helper.make_node("Sub", ["all", "next"], ["away"]),
        helper.make_node("Abs", ["away"], ["far"]),
        helper.make_node("Neg", ["far"], ["action_dist_inputs"]),
        helper.make_node("ArgMax", ["action_dist_inputs"], ["action"], axis=1, keepdims=0),
        helper.make_node("ArgMax", ["action_dist_inputs"], ["column"], axis=1, keepdims=1),
        helper.make_node("Cast", ["column"], ["taken"], to=TensorProto.FLOAT),
        helper.make_node("Add", ["taken", "one"], ["state_out_action"]),
    ]
    weights = {"count": [[actions]], "all": [list(range(actions))], "one": [[1]]}
    taken, given = {"observation": width, "state_in_action": 1}, {"action_dist_inputs": actions, "state_out_action": 1}
    graph = helper.make_graph(
        nodes,
        "following",
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size]) for name, size in taken.items()],
        [
            helper.make_tensor_value_info("action", TensorProto.INT64, ["batch"]),
            *(helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size]) for name, size in given.items()),
        ],
        [numpy_helper.from_array(np.array(value, np.float32), name) for name, value in weights.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    return bytes(model.SerializeToString())


def test_who_is_asked_for_advice_remembers_what_was_done_instead() -> None:
    _, described, _ = table(SPREAD, **BRIEF)
    width = inputs(described.of_policy("shared").observation)["observation"].shape[0]
    players = everybody(described, OnnxPolicy(following(width, actions=5)))

    def advised(*actions: int) -> int:
        return ask(SPREAD, players, "agent_0", actions, chances=True, kwargs=BRIEF).chances[0][0]

    assert [advised(), advised(0), advised(3), advised(3, 1), advised(3, 4)] == [0, 1, 4, 2, 0]


def test_nobody_is_told_chances_who_did_not_ask() -> None:
    _, described, _ = table(TICTACTOE)
    players = everybody(described, OnnxPolicy(examples.graph(wins=True)))
    sat = ask(TICTACTOE, players, "player_2")
    assert (sat.chances, {move.chances for step in sat.steps for move in step.moves}) == ((), {()})
    assert ask(TICTACTOE, scripted(described), "player_2", chances=True).chances == ()


def test_the_game_waits_for_the_person_with_what_may_be_done() -> None:
    players = everybody(table(TICTACTOE)[1], OnnxPolicy(examples.graph()))
    first = ask(TICTACTOE, players, "player_1")
    assert (first.legal, first.acting, first.over, len(first.steps)) == (tuple(range(9)), ("player_1",), False, 1)
    second = ask(TICTACTOE, players, "player_1", [4])
    assert moves_in(second)[1:] == [[("player_1", 4)], [("player_2", 1)]]
    assert second.legal == (0, 2, 3, 5, 6, 7, 8)


@pytest.mark.parametrize(("opponent", "choices", "score"), [("first", [2, 4, 6], 1.0), ("first", [3, 4, 8], 0.0)])
def test_a_game_that_is_won_or_lost_says_so(opponent: str, choices: list[int], score: float) -> None:
    sat = ask(TICTACTOE, scripted(table(TICTACTOE)[1], opponent), "player_1", choices)
    assert (sat.over, sat.score, sat.legal, sat.acting) == (True, score, (), ())
    assert sat.returns == {"player_1": 2 * score - 1, "player_2": 1 - 2 * score}


@pytest.mark.parametrize(("actions", "named"), [([4, 4], "4, number 2 of them"), ([9], "9, number 1"), ([-1], "-1")])
def test_an_illegal_choice_is_refused_naming_the_legal_ones(actions: list[int], named: str) -> None:
    players = everybody(table(TICTACTOE)[1], OnnxPolicy(examples.graph()))
    with pytest.raises(IllegalAction, match=f"{named}.*legal are .*2.*3.*8$"):
        ask(TICTACTOE, players, "player_1", actions)


def test_choices_after_the_end_are_refused() -> None:
    players = scripted(table(TICTACTOE)[1], "first")
    with pytest.raises(InvalidInput, match="over after 3 of these 5"):
        ask(TICTACTOE, players, "player_1", [2, 4, 6, 7, 8])


def test_only_agents_that_choose_are_played_by_a_person() -> None:
    players = scripted(table(TICTACTOE)[1])
    with pytest.raises(InvalidInput, match="there is no agent 'white'; known: player_1, player_2"):
        ask(TICTACTOE, players, "white")
    kwargs = BRIEF | {"continuous_actions": True}
    players = scripted(table(SPREAD, **kwargs)[1])
    with pytest.raises(EnvironmentMismatch, match="agent_0 acts by Box"):
        ask(SPREAD, players, "agent_0", kwargs=kwargs)


def test_an_opponent_without_an_action_forfeits_and_the_person_has_won() -> None:
    players = everybody(table(TICTACTOE)[1], OnnxPolicy(examples.graph(faulty=True)))
    sat = ask(TICTACTOE, players, "player_1", [1, 5, 8])
    assert sat.forfeits == ({"agent": "player_2", "ref": "script:random", "reason": "illegal_action"},)
    assert sat.score == 1.0


def test_what_an_environment_raises_is_told() -> None:
    players = scripted(table("tests.evaluation.hanging:Raising")[1])
    with pytest.raises(GameCrashed, match="ValueError: the board is gone"):
        ask("tests.evaluation.hanging:Raising", players, "player_1", [4])
