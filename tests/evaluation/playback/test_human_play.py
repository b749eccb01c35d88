"""A person's game depends on its seed and choices, and equals the game that policies would have played."""

from __future__ import annotations

import sys
from base64 import b64decode
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from pettingzoo.classic import connect_four_v3
from PIL import Image

from evaluation.playback.environment_hooks import KNOWN, Declarations, EnvironmentHooks, environment_hooks
from evaluation.playback.human_play import PERSON, human_play, playability
from evaluation.playback.single_game import GameStep, play_game
from league.conditions import ActionSelection
from league.config.environment import EnvironmentConfig
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.environments.implementation import stock_stepping
from league.environments.stepping import BatchedEnvironment
from league.errors import EnvironmentMismatch, GameCrashed, IllegalAction, InvalidInput, RemoteError
from league.interface import Interface
from league.policies.loading import contestant
from league.policies.onnx import OnnxPolicy
from league.policies.policy import Actions, Arrays, Policy
from league.registry.registry import Registry
from league.service_requests import GameForfeit, HumanPlayRequest, Playability, PlayedGame, RecordedStep
from league.spaces import inputs
from tests.support.environments.declaring import EVERYTHING, VIEWS
from tests.support.leagues import tictactoe
from tests.support.leagues.judged_league import STRONG, WEAK, promote

TICTACTOE = "pettingzoo.classic.tictactoe_v3"


CONNECT_FOUR = "pettingzoo.classic.connect_four_v3"


SPREAD = "mpe2.simple_spread_v3"


BRIEF = {"max_cycles": 8}


DECLARING = "tests.support.environments.declaring"
UNSEEN = EnvironmentHooks(draws=False, has_views=False, declared=Declarations())


@cache
def league_and_environment(
    entry_point: str, selection: ActionSelection | None = None, **kwargs: Any
) -> tuple[LeagueConfig, Interface, BatchedEnvironment]:
    """A league, and an environment that is reused for several games."""
    environment = {"entry_point": entry_point, "kwargs": dict(kwargs)}
    config = LeagueConfig.from_mapping({"league": "home", "environment": environment, "play": {"actions": selection}})
    return config, interface(config), stock_stepping(config.environment, 1)


def all_agents(described: Interface, policy: Policy) -> dict[str, Policy]:
    return dict.fromkeys(described.agents, policy)


def scripted_players(described: Interface, name: str = "random") -> dict[str, Policy]:
    return {agent: policy for agent, (_, policy) in contestant(f"script:{name}", None, described).items()}


def play_request(
    entry_point: str, players: Mapping[str, Policy], agent: str, actions: Sequence[int] = (), **options: Any
) -> PlayedGame:
    kwargs, selection = options.pop("kwargs", {}), options.pop("selection", None)
    config, described, environment = league_and_environment(entry_point, selection, **kwargs)
    request = HumanPlayRequest(opponent="script:random", agent=agent, actions=tuple(actions), **options)
    analyst = players.get(request.agent) if request.chances else None
    return human_play(request, config, described, players, analyst, environment, UNSEEN)


class Scripted:
    """Returns the choices of a person."""

    def __init__(self, choices: Sequence[int]) -> None:
        self._choices = iter(choices)

    def act(self, observations: Arrays, *, state: Any = None, explore: bool = False, rng: Any = None) -> Actions:
        return Actions(np.array([next(self._choices)]))


def moves_of(steps: Sequence[GameStep] | Sequence[RecordedStep]) -> list[list[tuple[str, Any]]]:
    return [[(move.agent, move.action) for move in step.moves] for step in steps]


@pytest.mark.parametrize(("entry_point", "kwargs"), [(TICTACTOE, {}), (CONNECT_FOUR, {}), (SPREAD, BRIEF)])
@settings(max_examples=25)
@given(data=st.data())
def test_a_game_is_reproducible_for_any_prefix_and_equals_one_of_policies(
    entry_point: str, kwargs: dict[str, Any], data: st.DataObject
) -> None:
    _, described, environment = league_and_environment(entry_point, **kwargs)
    agent = data.draw(st.sampled_from(list(described.agents)))
    seed = data.draw(st.integers(0, 2**63 - 1))
    players, choices = scripted_players(described), list[int]()
    so_far = [play_request(entry_point, players, agent, seed=seed, kwargs=kwargs)]
    while not so_far[-1].over:
        choices.append(data.draw(st.sampled_from(so_far[-1].legal)))
        so_far.append(play_request(entry_point, players, agent, choices, seed=seed, kwargs=kwargs))
    whole = so_far[-1]
    for number in data.draw(st.lists(st.integers(0, len(choices)), max_size=4)):
        again = play_request(entry_point, players, agent, choices[:number], seed=seed, kwargs=kwargs)
        assert again == so_far[number]
        assert whole.steps[: len(again.steps)] == again.steps
    played = list(play_game(environment, {**players, agent: Scripted(choices)}, seed))
    assert moves_of(whole.steps) == moves_of(played)
    assert whole.returns == played[-1].returns
    assert {move.ref for step in whole.steps for move in step.moves if move.agent == agent} == {PERSON}


@pytest.mark.parametrize("selection", ["greedy", "sampled"])
@pytest.mark.parametrize("memory", [False, True], ids=["without memory", "with memory"])
def test_playing_like_the_opponent_equals_self_play_of_the_opponent(memory: bool, selection: ActionSelection) -> None:
    _, described, environment = league_and_environment(SPREAD, selection, **BRIEF)
    spaces = described.of_policy("shared")
    players = all_agents(described, OnnxPolicy(tictactoe.linear(spaces, seed=3, memory=memory)))
    played = moves_of(list(play_game(environment, players, 0, selection)))
    drawn = [action for moves in played for agent, action in moves if agent == "agent_1"]
    options = {"chances": True, "selection": selection, "kwargs": BRIEF}
    choices: list[int] = []
    while not (state := play_request(SPREAD, players, "agent_1", choices, **options)).over:
        assert sum(chance for _, chance in state.chances) == pytest.approx(1, abs=1e-5)
        choices.append(state.chances[0][0] if selection == "greedy" else drawn[len(choices)])
    assert moves_of(state.steps) == played
    assert len(set(choices)) > 1 or not memory
    is_likeliest = {move.chances[0][0] == move.action for step in state.steps for move in step.moves}
    assert is_likeliest == ({True} if selection == "greedy" else {True, False})


def next_action_graph(width: int, actions: int) -> bytes:
    """A recurrent graph that prefers the action after its previous one."""
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
    sizes, output_sizes = (
        {"observation": width, "state_in_action": 1},
        {"action_dist_inputs": actions, "state_out_action": 1},
    )
    graph = helper.make_graph(
        nodes,
        "following",
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size]) for name, size in sizes.items()],
        [
            helper.make_tensor_value_info("action", TensorProto.INT64, ["batch"]),
            *(
                helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size])
                for name, size in output_sizes.items()
            ),
        ],
        [numpy_helper.from_array(np.array(value, np.float32), name) for name, value in weights.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    return bytes(model.SerializeToString())


def test_advice_depends_on_the_actions_actually_played() -> None:
    _, described, _ = league_and_environment(SPREAD, **BRIEF)
    width = inputs(described.of_policy("shared").observation)["observation"].shape[0]
    players = all_agents(described, OnnxPolicy(next_action_graph(width, actions=5)))

    def advice_after(*actions: int) -> int:
        return play_request(SPREAD, players, "agent_0", actions, chances=True, kwargs=BRIEF).chances[0][0]

    assert [advice_after(), advice_after(0), advice_after(3), advice_after(3, 1), advice_after(3, 4)] == [0, 1, 4, 2, 0]


def test_probabilities_are_returned_on_request_and_certain_without_a_distribution() -> None:
    _, described, _ = league_and_environment(TICTACTOE)
    players = all_agents(described, OnnxPolicy(tictactoe.graph(wins=True)))
    state = play_request(TICTACTOE, players, "player_2")
    assert (state.chances, {move.chances for step in state.steps for move in step.moves}) == ((), {()})
    assert play_request(TICTACTOE, scripted_players(described), "player_2", chances=True).chances == ()
    players = all_agents(described, OnnxPolicy(tictactoe.graph(wins=True), has_distribution=False))
    state = play_request(TICTACTOE, players, "player_2", chances=True)
    (move,) = state.steps[1].moves
    assert move.chances == ((move.action, 1.0),)
    assert [chance for _, chance in state.chances] == [1.0]


def test_the_state_has_the_legal_actions_of_the_person_and_others_are_rejected() -> None:
    players = all_agents(league_and_environment(TICTACTOE)[1], OnnxPolicy(tictactoe.graph()))
    first = play_request(TICTACTOE, players, "player_1")
    assert (first.legal, first.acting, first.over, len(first.steps)) == (tuple(range(9)), ("player_1",), False, 1)
    second = play_request(TICTACTOE, players, "player_1", [4])
    assert moves_of(second.steps)[1:] == [[("player_1", 4)], [("player_2", 1)]]
    assert second.legal == (0, 2, 3, 5, 6, 7, 8)
    for actions, message in (([4, 4], r"\[1\]: 4 is illegal"), ([9], r"\[0\]: 9 is illegal"), ([-1], "-1")):
        with pytest.raises(IllegalAction, match=f"{message}.*expected one of .*2.*3.*8$"):
            play_request(TICTACTOE, players, "player_1", actions)


def test_the_result_of_a_game_is_reported() -> None:
    players = scripted_players(league_and_environment(TICTACTOE)[1], "first")
    for choices, score in (([2, 4, 6], 1.0), ([3, 4, 8], 0.0)):
        state = play_request(TICTACTOE, players, "player_1", choices)
        assert (state.over, state.score, state.legal, state.acting) == (True, score, (), ())
        assert state.returns == {"player_1": 2 * score - 1, "player_2": 1 - 2 * score}
    with pytest.raises(InvalidInput, match="ended after 3 of 5"):
        play_request(TICTACTOE, players, "player_1", [2, 4, 6, 7, 8])


def test_a_person_can_play_only_agents_with_discrete_actions() -> None:
    players = scripted_players(league_and_environment(TICTACTOE)[1])
    with pytest.raises(InvalidInput, match="unknown agent 'white'; known: player_1, player_2"):
        play_request(TICTACTOE, players, "white")
    kwargs = BRIEF | {"continuous_actions": True}
    players = scripted_players(league_and_environment(SPREAD, **kwargs)[1])
    with pytest.raises(EnvironmentMismatch, match="agent_0 has Box"):
        play_request(SPREAD, players, "agent_0", kwargs=kwargs)


def test_an_opponent_without_a_legal_action_forfeits_but_not_one_that_is_unreachable() -> None:
    described = league_and_environment(TICTACTOE)[1]
    faulty = all_agents(described, OnnxPolicy(tictactoe.graph(faulty=True)))
    state = play_request(TICTACTOE, faulty, "player_1", [1, 5, 8])
    assert state.forfeits == (GameForfeit(agent="player_2", ref="script:random", reason="illegal_action"),)
    assert state.score == 1.0

    class Unreachable(Scripted):
        def act(self, observations: Arrays, *, state: Any = None, explore: bool = False, rng: Any = None) -> Actions:
            raise RemoteError("http://127.0.0.1:9/v2/models/board cannot be reached")

    with pytest.raises(RemoteError, match="cannot be reached"):
        play_request(TICTACTOE, all_agents(described, Unreachable([])), "player_1", [4])
    raising = "tests.support.environments.hanging:Raising"
    with pytest.raises(GameCrashed, match="ValueError: the board is gone"):
        play_request(raising, scripted_players(league_and_environment(raising)[1]), "player_1", [4])


def test_the_picture_is_the_view_of_the_agent_if_the_environment_has_one() -> None:
    config, described, _ = league_and_environment(f"{DECLARING}:Declaring")
    hooks, players = environment_hooks(config.environment), scripted_players(described, "first")
    environment = stock_stepping(config.environment, 1, render_mode="rgb_array")

    def brightness(hooks: EnvironmentHooks, agent: str) -> int:
        request = HumanPlayRequest(opponent="script:first", agent=agent)
        picture = human_play(request, config, described, players, None, environment, hooks).picture
        return int(np.asarray(Image.open(BytesIO(b64decode(picture.partition(",")[2]))).convert("L"))[0, 0])

    whole = replace(hooks, has_views=False)
    views = [brightness(hooks, "player_1"), brightness(hooks, "player_2"), brightness(whole, "player_2")]
    assert views == [VIEWS["player_1"], VIEWS["player_2"], EVERYTHING]


def playable(registry: Registry, config: LeagueConfig) -> Playability:
    """What a league with this configuration offers to people."""
    registry.leagues.register(config, interface(config))
    return playability(config, registry, interface(config), environment_hooks(config.environment))


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    with closing(tictactoe.registry(tmp_path)) as opened:
        yield opened


def test_agents_have_the_declared_names_keys_and_colors_and_revealing_pictures_are_reported(registry: Registry) -> None:
    for name, reveals in (("Declaring", False), ("Revealing", True), ("Open", False)):
        offer = playable(registry, tictactoe.config(environment={"entry_point": f"{DECLARING}:{name}"}))
        assert (offer.draws, offer.reveals) == (True, reveals), name
    names = ["left", *"bcdefgh", "right"]
    declaring = {"entry_point": f"{DECLARING}:Declaring"}
    offer = playable(registry, tictactoe.config(environment=declaring, play={"action_names": names}))
    first, second = offer.agents
    assert first.names == {str(action): name for action, name in enumerate(names)}
    assert first.keys == {"ArrowLeft": 0, "a": 0, "ArrowRight": 8, "d": 4}, "declared keys precede; 99 is no action"
    assert (first.color, second.color) == ("red", None)
    assert offer.board == ((0, None), (1, 2))


def test_opponents_that_can_play_are_offered(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    """Scripts of the configuration, and versions and mixtures of the environment."""
    monkeypatch.setitem(sys.modules, "pyspiel", None)  # `mcts_100` needs it
    anchors = ["script:minimax_2", "script:mirror", "script:mcts_100"]
    opponents = [{"ref": f"script:{name}", "share": 0.1} for name in ("solver", "one_ply")]
    config = tictactoe.config(gate={"anchors": anchors}, training={"opponents": opponents})
    assert playable(registry, config).opponents == (
        "script:random",
        "script:one_ply",
        "script:minimax_2",
        "script:solver",
    )
    for graph in (STRONG, WEAK):
        tictactoe.publish(registry, graph)
    registry.publisher.publish_mixture(tictactoe.LEAGUE, {1: 0.5, 2: 0.5})
    promote(registry, 3)
    other = tictactoe.config(environment={"entry_point": TICTACTOE, "kwargs": {"screen_height": 500}})
    for league, versions in ((config, {"tictactoe@1", "tictactoe@2", "tictactoe@3"}), (other, set())):
        refs = playable(registry, league).opponents
        assert {ref for ref in refs if not ref.startswith("script:")} == versions


def test_what_is_declared_is_used(subtests: pytest.Subtests) -> None:
    for entry_point, board in (
        (CONNECT_FOUR, ((0, 1, 2, 3, 4, 5, 6),)),
        (TICTACTOE, ((0, 3, 6), (1, 4, 7), (2, 5, 8))),
        (SPREAD, None),
        (f"{DECLARING}:Declaring", ((0, None), (1, 2))),
    ):
        assert environment_hooks(EnvironmentConfig(entry_point=entry_point)).declared.board == board
    document = {"entry_point": f"{DECLARING}:Declaring", "wrappers": ["pad_action_space_v0"]}
    wrapped = environment_hooks(EnvironmentConfig.model_validate(document))
    assert (wrapped.draws, wrapped.has_views) == (True, True)
    assert (wrapped.declared.agent_colors, wrapped.declared.board_area) == ({"player_1": "red"}, (0, 0, 1, 1))
    assert environment_hooks(EnvironmentConfig(entry_point="policy_league.examples.kuhn_poker:env")).draws is False
    config = EnvironmentConfig(entry_point=f"{DECLARING}:Malformed", kwargs={"board": [[3]]})
    assert environment_hooks(config).declared.board == ((3,),), "that of the instance"
    for declared, message in (
        ({"board": [[0, 1], [2]]}, "board: .*rows of equal length"),
        ({"board": []}, "board: .*rows of equal length"),
        ({"board": [["a"]]}, r"board\[0\]\[0\]: .*integer"),
        ({"board_area": [0, 0, 1]}, r"board_area\[3\]: .*required"),
        ({"board_area": [0.5, 0, 0.5, 1]}, "board_area: .*left < right"),
        ({"board_area": [0, 0, 640, 480]}, "board_area: .*between 0 and 1"),
        ({"board_area": [float("nan"), 0, 1, 1]}, "board_area: .*between 0 and 1"),
        ({"action_keys": {"w": "up"}}, "action_keys.w: .*integer"),
        ({"agent_colors": {"player_1": "url(x)"}}, "agent_colors: .*player_1: 'url\\(x\\)' is neither"),
    ):
        config = EnvironmentConfig(entry_point=f"{DECLARING}:Malformed", kwargs=declared)
        pattern = f"metadata of {DECLARING}:Malformed: {message}"
        with subtests.test(declared=declared), pytest.raises(EnvironmentMismatch, match=pattern):
            environment_hooks(config)


def test_cells_of_connect_four_are_around_its_holes() -> None:
    """The holes are the white parts of the picture of an empty board."""
    with closing(connect_four_v3.env(render_mode="rgb_array")) as env:
        env.reset()
        holes = env.render().min(axis=2) == 255
    left, top, right, bottom = KNOWN["connect_four_v3"]["board_area"]
    height, width = holes.shape
    for centres, (low, high), cells in (
        (centres_of(holes.any(axis=0)) / width, (left, right), 7),
        (centres_of(holes.any(axis=1)) / height, (top, bottom), 6),
    ):
        assert centres == pytest.approx(low + (np.arange(cells) + 0.5) * (high - low) / cells, abs=0.002)


def centres_of(inside: NDArray[np.bool_]) -> NDArray[np.float64]:
    """The centres of the runs of True, in pixels."""
    edges = np.flatnonzero(np.diff(np.pad(inside, 1).astype(int)))
    return (edges[::2] + edges[1::2]) / 2
