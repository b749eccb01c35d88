"""Games step by step: recorded ones as documents, Parquet and videos, live ones, and their captions."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator, Sequence
from contextlib import closing
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from pettingzoo.classic import tictactoe_v3
from PIL import Image, ImageColor

from evaluation.matches.tournament import evaluate
from evaluation.playback import dataset
from evaluation.playback.action_names import action_names, direction_keys
from evaluation.playback.captions import Captions
from evaluation.playback.dataset import write_games
from evaluation.playback.environment_hooks import KNOWN
from evaluation.playback.recorded_steps import RecordedGame, recorded_steps
from evaluation.playback.replay import GameSource, live_game, recorded_game
from evaluation.playback.single_game import GameStep, Move, first_observation, play_game
from evaluation.playback.video import FrameComposer, show_window, write_video
from league.config.league import LeagueConfig
from league.environments import building
from league.environments.building import build, interface
from league.environments.implementation import stock_stepping
from league.errors import ConfigError, EnvironmentMismatch, InvalidReference, NotFound, StorageError, UnknownPolicy
from league.interface import AgentInterface, Interface
from league.policies.loading import contestant
from league.policies.onnx import OnnxPolicy
from league.registry.registry import Registry
from league.results.ledger import Ledger
from league.results.records import Match
from league.search.policies import publish_search
from league.service_requests import MOST_STEPS, RecordingRequest
from league.spaces import Box, Discrete, MultiDiscrete, Space
from tests.support.leagues import tictactoe
from tests.support.leagues.judged_league import promote
from tests.support.leagues.tictactoe import LEAGUE
from tests.support.policies.graphs import masked_mlp


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    """Tic-tac-toe with two versions."""
    with closing(tictactoe.registry(tmp_path / "home")) as opened:
        for wins in (False, True):
            tictactoe.publish(opened, tictactoe.graph(wins=wins))
        yield opened


def play_match(registry: Registry, league: str = LEAGUE, *refs: str) -> Match:
    evaluate(league, refs, registry=registry, blocks=1)
    return Ledger(registry).matches(league=league)[0]


def record_steps(registry: Registry, match: Match, game: int = 0, draws: bool = False, **options: int) -> RecordedGame:
    request = RecordingRequest(match=match.id, game=game, **options)
    source = recorded_game(match.id, game, registry, chances=True, request=request)
    environment = stock_stepping(source.config.environment, 1, render_mode="rgb_array" if draws else None)
    return recorded_steps(source, match, request, environment, draws)


def test_each_step_has_actions_and_probabilities(registry: Registry) -> None:
    match = play_match(registry, LEAGUE, "tictactoe@2", "script:random")
    for number, game in enumerate(match.games):
        record = record_steps(registry, match, number)
        assert [move.action for step in record.steps for move in step.moves] == [*game.opening, *game.actions]
        assert [step.opening for step in record.steps] == [False, True, True] + [False] * (record.length - 2)
        assert set(record.players.values()) == set(match.contestants)
        for step in record.steps[1:]:
            (move,) = step.moves
            assert move.ref == record.players[move.agent]
            if step.opening or move.ref == "script:random":
                assert move.chances == (), "no policy chose it, or its probabilities are unknown"
            else:
                assert move.chances[0][0] == move.action, "checkpoints act greedily"
                assert sum(chance for _, chance in move.chances) == pytest.approx(1, abs=1e-4)
        assert (record.fault, set(record.returns.values())) == (None, set(game.returns))
        json.dumps(record.model_dump(), allow_nan=False)
    source = recorded_game(match.id, 0, registry, chances=True)
    policy = OnnxPolicy(tictactoe.graph(wins=True))
    for step in source.play(stock_stepping(source.config.environment, 1)):
        for move in step.moves:
            if move.dist_inputs is not None:
                batch = {name: array[np.newaxis] for name, array in move.observation.items()}
                np.testing.assert_array_equal(move.dist_inputs, policy.distribution(batch).dist_inputs[0])


def test_a_search_version_evaluates_the_positions_of_other_players(registry: Registry) -> None:
    match = play_match(registry, LEAGUE, "tictactoe@2", "script:random")
    value = masked_mlp((3, 3, 2), 9, has_value=True)
    base = tictactoe.publish(registry, masked_mlp((3, 3, 2), 9), value=value)
    league = registry.leagues.get(LEAGUE)
    search = publish_search(registry, base, league.config.environment, league.interface, "puct", 300)
    record = record_steps(registry, match, analysis=search.number)
    moves = [move for step in record.steps[3:] for move in step.moves]
    assert all(move.value is not None and -1 <= move.value <= 1 for move in moves)
    assert all(sum(chance for _, chance in move.chances) == pytest.approx(1, abs=1e-4) for move in moves)
    winner = moves[-1]
    assert record.returns[winner.agent] == 0 or winner.value > 0.5, "the last move wins, unless the game is a draw"
    assert record_steps(registry, match).steps[-1].moves[0].value is None


def test_recurrent_state_starts_after_the_opening(registry: Registry) -> None:
    environment = {"entry_point": "mpe2.simple_spread_v3", "kwargs": {"max_cycles": 6}}
    config = LeagueConfig.from_mapping({"league": "spread", "environment": environment, "play": {"opening_plies": 2}})
    registry.leagues.register(config, interface(config))
    spaces = registry.leagues.get("spread").interface.of_policy("shared")
    tictactoe.publish(registry, tictactoe.linear(spaces, seed=1, memory=True), "spread")
    match = play_match(registry, "spread", "spread@1", "script:random")
    book = record_steps(registry, match, next(i for i, game in enumerate(match.games) if game.sides[0] == 0))
    moves = [move for step in book.steps[3:] for move in step.moves if move.ref == "spread@1"]
    assert moves
    assert all(move.chances[0][0] == move.action for move in moves)


def test_images_change_between_steps_and_a_missing_version_has_no_probabilities(registry: Registry) -> None:
    match = play_match(registry, LEAGUE, "tictactoe@2", "script:random")
    record = record_steps(registry, match, draws=True)
    kinds, data = zip(*(str(step.picture).split(",") for step in record.steps), strict=True)
    assert set(kinds) == {"data:image/png;base64"}
    images = [np.array(Image.open(BytesIO(base64.b64decode(image))).convert("RGB")) for image in data]
    assert max(images[0].shape) == 480
    assert len({picture.tobytes() for picture in images}) == len(images)
    (registry.artifacts.path(LEAGUE, 2) / "shared.onnx").unlink()
    record = record_steps(registry, match)
    assert record.fault is None
    assert {move.chances for step in record.steps for move in step.moves} == {()}


def test_long_games_are_returned_in_parts() -> None:
    rows: list[tuple[dict[str, int], Sequence[int]]] = [
        ({}, range(126)),
        ({"first": 120}, range(120, 126)),
        ({"first": 3, "end": 6}, range(3, 6)),
        ({"every": 50}, [0, 50, 100, 125]),
        ({"first": 10, "every": 40, "end": 100}, [10, 50, 90]),
        ({"first": 126}, []),
    ]
    for options, expected in rows:
        recording = RecordingRequest(match="m/0", game=0, **options)
        steps = [step for step in range(126) if recording.includes(step, step == 125)]
        assert steps == list(expected)[:MOST_STEPS]


@given(st.integers(1, 20), st.integers(0, 1500))
def test_the_number_of_steps_in_a_part_is_limited(every: int, length: int) -> None:
    recording = RecordingRequest(match="m/0", game=0, every=every)
    assert sum(recording.includes(step, step == length) for step in range(length + 1)) <= MOST_STEPS


def test_forfeits_are_reported(registry: Registry) -> None:
    tictactoe.publish(registry, tictactoe.graph(faulty=True))
    evaluate(LEAGUE, ["tictactoe@2", "tictactoe@3"], registry=registry, blocks=8)
    matches = Ledger(registry).matches(league=LEAGUE)
    match, number = next((m, i) for m in matches for i, game in enumerate(m.games) if game.forfeits)
    book = record_steps(registry, match, number)
    (forfeit,) = book.forfeits
    assert (forfeit.ref, forfeit.reason) == ("tictactoe@3", "illegal_action")
    assert (book.players[forfeit.agent], book.fault) == ("tictactoe@3", None)


def test_a_game_that_cannot_be_replayed_has_a_reason(registry: Registry) -> None:
    match = play_match(registry)
    registry.leagues.register(
        tictactoe.config(environment={"entry_point": "tests.support.environments.hanging:Raising"}),
        registry.leagues.get(LEAGUE).interface,
    )
    book = record_steps(registry, match)
    assert (book.steps, book.length, book.returns) == ((), 0, {})
    assert "not played in the current environment" in str(book.fault)


def rows_of(path: Path) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = pq.read_table(path).to_pylist()
    return sorted(rows, key=lambda row: (row["match"], row["game"], row["step"], row["agent"]))


def test_the_rows_are_the_recorded_games(registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dataset, "ROWS_OF_GROUP", 7)
    evaluate(LEAGUE, ("tictactoe@1", "tictactoe@2", "script:random"), registry=registry, blocks=2)
    counts = write_games(registry, LEAGUE, tmp_path / "games")
    rows = rows_of(tmp_path / "games" / "shared.parquet")
    assert counts == {"shared": len(rows)}
    matches = {match.id: match for match in Ledger(registry).matches(league=LEAGUE)}
    assert {row["match"] for row in rows} == set(matches)
    for match in matches.values():
        for number, game in enumerate(match.games):
            decisions = [row for row in rows if (row["match"], row["game"]) == (match.id, number)]
            assert [row["action"] for row in decisions] == [*game.opening, *game.actions]
            assert [row["is_opening"] for row in decisions] == [True] * len(game.opening) + [False] * len(game.actions)
            assert all(row["action_mask"][row["action"]] for row in decisions)
            for side, agent in enumerate(("player_1", "player_2")):
                of_agent = [row for row in decisions if row["agent"] == agent]
                assert {row["player"] for row in of_agent} == {match.contestants[game.sides[side]]}
                assert sum(row["reward"] for row in of_agent) == game.returns[game.sides[side]]
                assert [row["terminated"] for row in of_agent] == [False] * (len(of_agent) - 1) + [True]


def test_observations_are_those_of_the_environment(registry: Registry, tmp_path: Path) -> None:
    evaluate(LEAGUE, ("tictactoe@1", "tictactoe@2"), registry=registry, blocks=1)
    write_games(registry, LEAGUE, tmp_path / "games", limit=1)
    path = tmp_path / "games" / "shared.parquet"
    shapes = json.loads(pq.read_schema(path).metadata[b"policy_league"])["shapes"]
    environment = tictactoe_v3.env()
    environment.reset()
    for row in rows_of(path):
        assert row["agent"] == environment.agent_selection
        for name, array in environment.observe(row["agent"]).items():
            np.testing.assert_array_equal(np.reshape(row[name], shapes[name]), array)
        environment.step(row["action"])
    assert all(environment.terminations.values())


def always_one(_: NDArray) -> int:
    return 1


def test_agents_that_act_together_and_leave_at_different_times(registry: Registry, tmp_path: Path) -> None:
    """Agent i observes (i, step, seed modulo 97), and earns 10^i in each step."""
    meeting = {"entry_point": SIMULTANEOUS, "kwargs": {"leaves": [2, 4], "truncated": [1]}}
    document = {"league": "meeting", "environment": meeting, "policies": {"a": ["agent_0"], "b": ["*"]}}
    config = LeagueConfig.from_mapping(document)
    registry.leagues.register(config, interface(config))
    evaluate("meeting", ("script:random", f"script:{__name__}:always_one"), registry=registry, blocks=1)
    assert write_games(registry, "meeting", tmp_path / "games", limit=1) == {"a": 2, "b": 4}
    for agent, (name, length) in enumerate((("a", 2), ("b", 4))):
        rows = rows_of(tmp_path / "games" / f"{name}.parquet")
        assert [row["step"] for row in rows] == list(range(length))
        assert [row["observation"][:2] for row in rows] == [[agent, time] for time in range(length)]
        assert [row["reward"] for row in rows] == [10**agent] * length
        assert (rows[-1]["terminated"], rows[-1]["truncated"]) == (agent == 0, agent == 1)
        assert not any(row["terminated"] or row["truncated"] for row in rows[:-1])


def test_decisions_of_one_player(registry: Registry, tmp_path: Path) -> None:
    evaluate(LEAGUE, ("tictactoe@1", "tictactoe@2"), registry=registry, blocks=2)
    write_games(registry, LEAGUE, tmp_path / "games", ["tictactoe@2"], limit=3)
    rows = rows_of(tmp_path / "games" / "shared.parquet")
    assert {row["player"] for row in rows} == {"tictactoe@2"}
    assert len({(row["match"], row["game"]) for row in rows}) == 3


def test_nothing_is_written_after_a_fault(registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    directory = tmp_path / "games"
    with pytest.raises(NotFound, match="tictactoe has no games under its current rules"):
        write_games(registry, LEAGUE, directory)
    evaluate(LEAGUE, ("tictactoe@1", "tictactoe@2"), registry=registry, blocks=1)
    tictactoe.publish(registry, tictactoe.graph(blocks=True))
    with pytest.raises(NotFound, match="tictactoe has no games of tictactoe@3 under its current rules"):
        write_games(registry, LEAGUE, directory, ["tictactoe@3"])

    def deviate(*_: Any) -> Any:
        raise EnvironmentMismatch("the game deviates")

    monkeypatch.setattr(dataset, "_rewarded", deviate)
    with pytest.raises(EnvironmentMismatch):
        write_games(registry, LEAGUE, directory)
    assert [path.name for path in tmp_path.iterdir()] == ["home"]
    directory.mkdir()
    (directory / "mine").touch()
    with pytest.raises(ConfigError, match="expected a new or empty folder"):
        write_games(registry, LEAGUE, directory)


SIMULTANEOUS = "tests.support.environments.simultaneous:meeting"


def test_changed_spaces_are_named(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    row = registry.leagues.get("tictactoe")
    other = AgentInterface(observation=Box(dtype="float32", shape=(3,), low=0, high=1), action=Discrete(n=9))
    changed = row.interface.model_copy(update={"agents": dict.fromkeys(row.interface.agents, other)})
    monkeypatch.setattr(building, "interface", lambda _: changed)
    with pytest.raises(EnvironmentMismatch, match="the spaces or policies of tictactoe@2 differ from those of the env"):
        live_game(["tictactoe@2"], registry)


def read_video(path: Path) -> tuple[tuple[int, int], list[Image.Image], list[int]]:
    with Image.open(path) as video:
        frames, durations = [], []
        for index in range(video.n_frames):  # type: ignore[attr-defined]
            video.seek(index)
            frames.append(video.convert("RGB"))
            durations.append(int(video.info["duration"]))
        return video.size, frames, durations


@pytest.mark.parametrize("suffix", [".gif", ".webp"])
def test_a_turn_based_game_has_a_frame_for_each_move(registry: Registry, tmp_path: Path, suffix: str) -> None:
    out, captions = tmp_path / f"game{suffix}", list[str]()
    source = live_game(["tictactoe@2", "script:one_ply"], registry)
    result = write_video(source, out, listener=lambda caption: captions.append(caption.step))
    size, frames, durations = read_video(out)
    assert result.is_whole
    assert captions == ["start", *(f"step {i}" for i in range(1, result.steps)), f"step {result.steps} · end"]
    assert len(frames) == result.steps + 1
    assert size[0] == 640
    assert durations[:-1] == [500] * result.steps
    assert sum(result.returns.values()) == 0
    assert len({frame.tobytes() for frame in frames}) == len(frames), "all frames differ"
    if suffix == ".gif":
        assert durations[-1] == 2000
        colors = KNOWN["tictactoe_v3"]["agent_colors"].values()
        for frame in (frames[0], frames[-1]):
            legend = np.array(frame.crop((10, frame.height - 70, 28, frame.height))).reshape(-1, 3).astype(int)
            assert [abs(legend - ImageColor.getrgb(color)).max(axis=1).min() < 16 for color in colors] == [True, True]


def test_simultaneous_agents_have_a_frame_for_each_step_up_to_a_limit(registry: Registry, tmp_path: Path) -> None:
    environment = {"entry_point": "mpe2.simple_spread_v3"}
    config = LeagueConfig.from_mapping({"league": "spread", "environment": environment, "sides": {"team": ["*"]}})
    registry.leagues.register(config, described := interface(config))
    tictactoe.publish(registry, tictactoe.linear(described.of_policy("shared"), 1), "spread")
    result = write_video(live_game(["spread@1"], registry, seed=4), tmp_path / "spread.gif")
    _, frames, durations = read_video(tmp_path / "spread.gif")
    assert (result.steps, len(frames), set(durations[:-1])) == (25, 26, {100})
    result = write_video(live_game(["tictactoe@1"], registry), tmp_path / "short.gif", max_frames=3, fps=4)
    _, frames, durations = read_video(tmp_path / "short.gif")
    assert (result.steps, result.is_whole) == (2, False)
    assert (len(frames), durations[:2]) == (3, [250, 250])


def test_a_recorded_match_is_shown_as_played(registry: Registry, tmp_path: Path) -> None:
    evaluate(LEAGUE, ["tictactoe@1", "tictactoe@2"], registry=registry, blocks=2)
    match = Ledger(registry).matches(league=LEAGUE)[1]
    for index, game in enumerate(match.games):
        source = recorded_game(match.id, index, registry)
        assert list(source.controllers.values()) == [match.contestants[number] for number in game.sides]
        done = write_video(source, tmp_path / "match.gif")
        assert (done.is_whole, done.steps) == (True, len(game.opening) + len(game.actions))
        returns = {source.controllers[agent]: value for agent, value in done.returns.items()}
        assert returns == dict(zip(match.contestants, game.returns, strict=True))
    with pytest.raises(InvalidReference, match="has games 0 to 1, not 2"):
        recorded_game(match.id, 2, registry)
    for unknown in (f"{match.schedule}/999", f"{match.schedule}/x", "no-such-schedule/0"):
        with pytest.raises(NotFound):
            recorded_game(unknown, 0, registry)


def test_contestants_are_assigned_to_agents(registry: Registry) -> None:
    def controllers(*refs: str, side: str | None = None) -> list[str]:
        return list(live_game(refs, registry, side).controllers.values())

    assert controllers("tictactoe@2") == ["tictactoe@2", "tictactoe@2"]
    assert controllers("tictactoe@2", "script:random") == ["tictactoe@2", "script:random"]
    assert controllers("tictactoe@2", "script:random", side="player_2") == ["script:random", "tictactoe@2"]
    promote(registry, 1)
    assert controllers("tictactoe@champion") == ["tictactoe@1", "tictactoe@1"]
    for refs, side, message in (
        (["script:random"], None, "at least one version"),
        (["tictactoe@1"] * 3, None, r"3 contestants for 2 side\(s\): player_1, player_2"),
        (["tictactoe@1"], "player_0", "unknown side 'player_0'; known: player_1, player_2"),
    ):
        with pytest.raises(InvalidReference, match=message):
            live_game(refs, registry, side)


def test_what_cannot_be_shown_leaves_no_file(
    registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    game = live_game(["tictactoe@1"], registry)
    with pytest.raises(ConfigError, match=r"game\.mp4: expected a name that ends in \.gif or \.webp"):
        write_video(game, tmp_path / "game.mp4")
    (tmp_path / "game.gif").mkdir()
    for path in (tmp_path / "nowhere" / "game.gif", tmp_path / "game.gif"):
        with pytest.raises(StorageError, match="cannot be written"):
            write_video(game, path)
    assert {path.name for path in tmp_path.iterdir()} == {"home", "game.gif"}
    document = {
        "league": "meeting",
        "environment": {"entry_point": SIMULTANEOUS},
        "policies": {"a": ["agent_0"], "b": ["*"]},
    }
    config = LeagueConfig.from_mapping(document)
    source = GameSource("meeting", config, interface(config), {"agent_0": "script:random"}, lambda _: iter(()))
    with pytest.raises(EnvironmentMismatch, match=r"has no render_mode 'rgb_array' \(it has none\)"):
        write_video(source, tmp_path / "meeting.gif")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(EnvironmentMismatch, match="--watch needs a display"):
        show_window(game)


def test_images_are_scaled_to_a_suitable_size() -> None:
    for height, width, expected in (
        (1000, 550, (352, 640)),
        (560, 880, (640, 407)),
        (480, 480, (480, 480)),
        (20, 30, (300, 200)),
    ):
        assert FrameComposer(np.zeros((height, width, 3), np.uint8), 2)._picture == expected


def league(entry_point: str, **parts: Any) -> LeagueConfig:
    return LeagueConfig.from_mapping({"league": "shown", "environment": {"entry_point": entry_point}} | parts)


@pytest.mark.parametrize(
    ("entry_point", "simultaneous"), [("pettingzoo.classic.tictactoe_v3", False), ("mpe2.simple_spread_v3", True)]
)
def test_a_game_is_played_step_by_step(entry_point: str, simultaneous: bool) -> None:
    config = league(entry_point)
    league_interface = interface(config)
    players = {agent: policy for agent, (_, policy) in contestant("script:random", None, league_interface).items()}
    steps = list(play_game(stock_stepping(config.environment, 1), players, seed=3))
    assert [step.step for step in steps] == list(range(len(steps)))
    assert [step.is_over for step in steps] == [False] * (len(steps) - 1) + [True]
    assert steps[0].moves == ()
    assert {len(step.moves) for step in steps[1:]} == {len(league_interface.agents) if simultaneous else 1}
    assert sorted(ending.agent for ending in steps[-1].endings) == list(range(len(league_interface.agents)))
    again = list(play_game(stock_stepping(config.environment, 1), players, seed=3))
    other = list(play_game(stock_stepping(config.environment, 1), players, seed=4))
    actions = [[[move.action for move in step.moves] for step in game] for game in (steps, again, other)]
    assert actions[0] == actions[1] != actions[2]
    assert steps[-1].returns == again[-1].returns


@pytest.mark.parametrize("entry_point", ["pettingzoo.classic.tictactoe_v3", "pettingzoo.classic.leduc_holdem_v4"])
def test_the_first_observation_equals_that_of_the_environment(entry_point: str) -> None:
    config = league(entry_point)
    env = build(config.environment)
    env.reset(seed=5)
    expected = env.observe(env.agent_selection)
    observation = first_observation(config, interface(config), None, seed=5)
    assert set(observation) == set(expected) == {"observation", "action_mask"}
    for key, value in expected.items():
        assert np.array_equal(np.array(observation[key], value.dtype), value)


def test_each_policy_that_acts_first_has_a_first_observation() -> None:
    config = league("mpe2.simple_adversary_v3", policies={"adversary": ["adversary_*"], "good": ["agent_*"]})
    expected, _ = build(config.environment).reset(seed=5)
    for policy, agent in (("adversary", "adversary_0"), ("good", "agent_0")):
        observation = first_observation(config, interface(config), policy, seed=5)
        assert np.array_equal(np.array(observation, np.float32), expected[agent])
    config = league("pettingzoo.classic.tictactoe_v3", policies={"first": ["player_1"], "second": ["player_2"]})
    with pytest.raises(UnknownPolicy, match=r"'second' does not act first in shown \('first' does\)"):
        first_observation(config, interface(config), "second")


OBSERVATION = Box(dtype="float32", shape=(2,), low=None, high=None)


def described(agents: int, action: Space, policies: int = 1) -> Interface:
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
    caption = captions(described(2, Discrete(n=3)), refs=2)
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
    two, many = described(2, Discrete(n=3)), described(8, Discrete(n=3), policies=2)
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
    caption = captions(described(1, Discrete(n=4, start=5)))
    logits = np.log([0.1, 0.6, 0.05, 0.25])
    (line,) = caption.of(game_step(1, {0: 6}, 1, logits)).lines
    assert [action for action, _ in line.chances] == ["6", "8", "5"]
    assert [chance for _, chance in line.chances] == pytest.approx([0.6, 0.25, 0.1])


def test_each_element_of_an_action_has_its_probability() -> None:
    caption = captions(described(1, MultiDiscrete(nvec=[2, 3], start=[0, 1], shape=(2,))))
    inputs = np.concatenate([np.log([0.2, 0.8]), np.log([0.5, 0.1, 0.4])])
    (line,) = caption.of(game_step(1, {0: [1, 1]}, 1, inputs)).lines
    assert line.action == "1 1"
    assert [action for action, _ in line.chances] == ["1", "1"]
    assert [chance for _, chance in line.chances] == pytest.approx([0.8, 0.5])


def test_continuous_actions_are_means() -> None:
    caption = captions(described(1, Box(dtype="float32", shape=(6,), low=-1.0, high=1.0)))
    (line,) = caption.of(game_step(1, {0: [0.25, -1.0, 0, 0, 1, 1]}, 1, np.zeros(12))).lines
    assert (line.action, line.chances) == ("+0.25 -1.00 +0.00 +0.00 …", ())
    caption = captions(described(20, Box(dtype="float32", shape=(1,), low=-1.0, high=1.0)))
    (line,) = caption.of(game_step(1, {i: [0.05 * i] for i in range(20)}, 20)).lines
    assert line.action == "mean +0.47"


def test_many_agents_share_a_line_by_policy_and_player() -> None:
    caption = captions(described(20, Discrete(n=3), policies=2))
    first, second = caption.of(game_step(1, {i: (i // 2) % 5 // 4 for i in range(20)}, 20)).lines
    assert (first.name, second.name) == ("policy_0 (10 agents)", "policy_1 (10 agents)")
    assert first.action == ""
    assert first.chances == (("0", 0.8), ("1", 0.2))
    assert (first.value, second.value) == (9.0, 10.0)


def test_names_of_directions_have_keys() -> None:
    rows: list[tuple[tuple[str, ...], dict[str, int]]] = [
        (("up", "left", "down", "right"), {"w": 0, "ArrowUp": 0, "a": 1, "s": 2, "d": 3}),
        (("no_action", "move_left", "MOVE RIGHT"), {"a": 1, "ArrowRight": 2, "d": 2}),
        (("North", "go west"), {"ArrowUp": 0, "ArrowLeft": 1}),
        (("up-left", "up", "fire left", "left"), {"ArrowUp": 1, "ArrowLeft": 3}),
        (("jump left", "fire left"), {}),
        (("rock", "paper", "leftover", "supper"), {}),
    ]
    for names, keys in rows:
        actions = direction_keys({str(action): name for action, name in enumerate(names)})
        assert actions.items() >= keys.items()
        assert set(actions.values()) == set(keys.values())


def test_names_belong_to_the_policies_of_agents_and_follow_the_first_action() -> None:
    names = {"first": list("abcdefghi")}
    config = tictactoe.config(policies={"first": ["player_1"], "second": ["player_2"]}, play={"action_names": names})
    expected = {str(action): name for action, name in enumerate(names["first"])}
    assert action_names(config.play, building.interface(config)) == {"player_1": expected}
    config = LeagueConfig.load("policy_league/configs/simple_spread.yaml")
    named = action_names(config.play, building.interface(config))
    assert direction_keys(named["agent_0"]).items() >= {"ArrowLeft": 1, "ArrowRight": 2, "ArrowDown": 3, "w": 4}.items()
