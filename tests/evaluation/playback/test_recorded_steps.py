"""Recorded games as documents: actions, probabilities and images of each step."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from evaluation.matches.tournament import evaluate
from evaluation.playback.recorded_steps import RecordedGame, recorded_steps
from evaluation.playback.replay import recorded_game
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.environments.lockstep import stock_stepping
from league.policies.onnx import OnnxPolicy
from league.registry.registry import Registry
from league.results.ledger import Ledger
from league.results.records import Match
from league.search.policies import publish_search
from league.service_requests import MOST_STEPS, RecordingRequest
from tests.support.leagues import tictactoe
from tests.support.leagues.tictactoe import LEAGUE
from tests.support.policies.graphs import masked_mlp


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    opened = tictactoe.registry(tmp_path / "home")
    tictactoe.publish(opened, tictactoe.graph(wins=True))
    yield opened
    opened.close()


def play_match(registry: Registry, league: str = LEAGUE, *refs: str) -> Match:
    evaluate(league, refs, registry=registry, blocks=1)
    return Ledger(registry).matches(league=league)[0]


def record_steps(registry: Registry, match: Match, game: int = 0, draws: bool = False, **options: int) -> RecordedGame:
    request = RecordingRequest(match=match.id, game=game, **options)
    source = recorded_game(match.id, game, registry, chances=True, request=request)
    environment = stock_stepping(source.config.environment, 1, render_mode="rgb_array" if draws else None)
    return recorded_steps(source, match, request, environment, draws)


def test_each_step_has_actions_and_probabilities(registry: Registry) -> None:
    match = play_match(registry, LEAGUE, "tictactoe@1", "script:random")
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


def test_a_search_version_evaluates_the_positions_of_other_players(registry: Registry) -> None:
    match = play_match(registry, LEAGUE, "tictactoe@1", "script:random")
    value = masked_mlp((3, 3, 2), 9, has_value=True)
    base = tictactoe.publish(registry, masked_mlp((3, 3, 2), 9), value=value)
    league = registry.leagues.get(LEAGUE)
    search = publish_search(registry, base, league.config.environment, league.interface, "puct", 300)
    record = record_steps(registry, match, analysis=search.number)
    moves = [move for step in record.steps[3:] for move in step.moves]
    assert all(move.value is not None and -1 <= move.value <= 1 for move in moves)
    assert all(sum(chance for _, chance in move.chances) == pytest.approx(1, abs=1e-4) for move in moves)
    winner = moves[-1]
    assert winner.value is not None
    assert record.returns[winner.agent] == 0 or winner.value > 0.5, "the last move wins, unless the game is a draw"
    assert record_steps(registry, match).steps[-1].moves[0].value is None


def test_recurrent_state_starts_after_the_opening(registry: Registry) -> None:
    parts = LeagueConfig.from_mapping(
        {
            "league": "spread",
            "environment": {"entry_point": "mpe2.simple_spread_v3", "kwargs": {"max_cycles": 6}},
            "play": {"opening_plies": 2},
        }
    )
    registry.leagues.register(parts, interface(parts))
    spaces = registry.leagues.get("spread").interface.of_policy("shared")
    tictactoe.publish(registry, tictactoe.linear(spaces, seed=1, memory=True), "spread")
    match = play_match(registry, "spread", "spread@1", "script:random")
    book = record_steps(registry, match, next(i for i, game in enumerate(match.games) if game.sides[0] == 0))
    moves = [move for step in book.steps[3:] for move in step.moves if move.ref == "spread@1"]
    assert moves
    assert all(move.chances[0][0] == move.action for move in moves)


def test_a_game_of_a_missing_version_is_shown_without_probabilities(registry: Registry) -> None:
    match = play_match(registry)
    (registry.artifacts.path(LEAGUE, 1) / "shared.onnx").unlink()
    record = record_steps(registry, match)
    assert record.fault is None
    assert {move.chances for step in record.steps for move in step.moves} == {()}


def test_images_change_between_steps(registry: Registry) -> None:
    record = record_steps(registry, play_match(registry), draws=True)
    kinds, data = zip(*(str(step.picture).split(",") for step in record.steps), strict=True)
    assert set(kinds) == {"data:image/png;base64"}
    images = [np.array(Image.open(BytesIO(base64.b64decode(each))).convert("RGB")) for each in data]
    assert max(images[0].shape) == 480
    assert len({picture.tobytes() for picture in images}) == len(images)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, range(126)),
        ({"first": 120}, range(120, 126)),
        ({"first": 3, "end": 6}, range(3, 6)),
        ({"every": 50}, [0, 50, 100, 125]),
        ({"first": 10, "every": 40, "end": 100}, [10, 50, 90]),
        ({"first": 126}, []),
    ],
)
def test_long_games_are_returned_in_parts(options: dict[str, int], expected: range | list[int]) -> None:
    recording = RecordingRequest(match="m/0", game=0, **options)
    steps = [step for step in range(126) if recording.includes(step, step == 125)]
    assert steps == list(expected)[:MOST_STEPS]


@pytest.mark.parametrize("every", [1, 2, 3, 7])
def test_the_number_of_steps_in_a_part_is_limited(every: int) -> None:
    recording = RecordingRequest(match="m/0", game=0, every=every)
    for length in range(90, 1000, 13):
        assert sum(recording.includes(step, step == length) for step in range(length + 1)) <= MOST_STEPS, length


def test_forfeits_are_reported(registry: Registry) -> None:
    tictactoe.publish(registry, tictactoe.graph(faulty=True))
    evaluate(LEAGUE, ["tictactoe@1", "tictactoe@2"], registry=registry, blocks=8)
    match, number = next(
        (match, number)
        for match in Ledger(registry).matches(league=LEAGUE)
        for number, game in enumerate(match.games)
        if game.forfeits
    )
    book = record_steps(registry, match, number)
    (forfeit,) = book.forfeits
    assert (forfeit.ref, forfeit.reason, book.players[forfeit.agent]) == (
        "tictactoe@2",
        "illegal_action",
        "tictactoe@2",
    )
    assert book.fault is None


def test_a_game_that_cannot_be_replayed_has_a_reason(registry: Registry) -> None:
    match = play_match(registry)
    registry.leagues.register(
        tictactoe.config(environment={"entry_point": "tests.support.environments.hanging:Raising"}),
        registry.leagues.get(LEAGUE).interface,
    )
    book = record_steps(registry, match)
    assert (book.steps, book.length, book.returns) == ((), 0, {})
    assert "not played in the current environment" in str(book.fault)


def test_the_inputs_of_the_replay_are_those_of_the_policy(registry: Registry) -> None:
    match = play_match(registry, LEAGUE, "tictactoe@1", "script:random")
    source = recorded_game(match.id, 0, registry, chances=True)
    policy = OnnxPolicy(tictactoe.graph(wins=True))
    for step in source.play(stock_stepping(source.config.environment, 1)):
        for move in step.moves:
            if move.dist_inputs is not None:
                batch = {name: array[np.newaxis] for name, array in move.observation.items()}
                expected = policy.distribution(batch).dist_inputs
                assert expected is not None
                np.testing.assert_array_equal(move.dist_inputs, expected[0])
