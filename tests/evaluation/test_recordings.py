"""Recorded games as documents: what was done at each step, how likely that was, and what could be seen."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from evaluation.recordings import Recorded, leaf_through
from evaluation.shows import recorded
from evaluation.tournament import evaluate
from league.config import LeagueConfig
from league.environments.building import interface
from league.environments.lockstep import stepping
from league.games import MOST_STEPS, Recording
from league.policies.onnx import OnnxPolicy
from league.registry.registry import Registry
from league.results.ledger import Ledger
from league.results.records import Match
from tests.evaluation import examples
from tests.evaluation.examples import LEAGUE


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    opened = examples.registry(tmp_path / "home")
    examples.publish(opened, examples.graph(wins=True))
    yield opened
    opened.close()


def played(registry: Registry, league: str = LEAGUE, *refs: str) -> Match:
    evaluate(league, refs, registry=registry, blocks=1)
    return Ledger(registry).matches(league=league)[0]


def leafed(registry: Registry, match: Match, game: int = 0, draws: bool = False, **asked: int) -> Recorded:
    show = recorded(match.id, game, registry, chances=True)
    environment = stepping(show.config.environment, 1, render_mode="rgb_array" if draws else None)
    return leaf_through(show, match, Recording(match=match.id, game=game, **asked), environment, draws)


def test_each_step_says_who_did_what_and_how_likely_that_was(registry: Registry) -> None:
    match = played(registry, LEAGUE, "tictactoe@1", "script:random")
    for number, game in enumerate(match.games):
        book = leafed(registry, match, number)
        assert [move.action for step in book.steps for move in step.moves] == [*game.opening, *game.actions]
        assert [step.opening for step in book.steps] == [False, True, True] + [False] * (book.length - 2)
        assert set(book.cast.values()) == set(match.contestants)
        for step in book.steps[1:]:
            (move,) = step.moves
            assert move.ref == book.cast[move.agent]
            if step.opening or move.ref == "script:random":
                assert move.chances == (), "nobody chose it, or nobody can say how likely it was"
            else:
                assert move.chances[0][0] == move.action, "checkpoints play their best action"
                assert sum(chance for _, chance in move.chances) == pytest.approx(1, abs=1e-4)
        assert (book.fault, set(book.returns.values())) == (None, set(game.returns))
        json.dumps(book.to_json(), allow_nan=False)


def test_a_memory_begins_behind_the_opening_as_it_did_when_the_game_was_played(registry: Registry) -> None:
    parts = LeagueConfig.from_mapping(
        {
            "league": "spread",
            "environment": {"entry_point": "mpe2.simple_spread_v3", "kwargs": {"max_cycles": 6}},
            "play": {"opening_plies": 2},
        }
    )
    registry.register(parts, interface(parts))
    spaces = registry.league("spread").interface.of_policy("shared")
    examples.publish(registry, examples.linear(spaces, seed=1, memory=True), "spread")
    match = played(registry, "spread", "spread@1", "script:random")
    book = leafed(registry, match, next(i for i, game in enumerate(match.games) if game.sides[0] == 0))
    moves = [move for step in book.steps[3:] for move in step.moves if move.ref == "spread@1"]
    assert moves
    assert all(move.chances[0][0] == move.action for move in moves)


def test_a_version_that_is_gone_has_no_chances_but_its_game_is_shown(registry: Registry) -> None:
    match = played(registry)
    (registry.artifacts.path(LEAGUE, 1) / "shared.onnx").unlink()
    book = leafed(registry, match)
    assert book.fault is None
    assert {move.chances for step in book.steps for move in step.moves} == {()}


def test_pictures_change_from_step_to_step(registry: Registry) -> None:
    book = leafed(registry, played(registry), draws=True)
    kinds, data = zip(*(str(step.picture).split(",") for step in book.steps), strict=True)
    assert set(kinds) == {"data:image/png;base64"}
    pictures = [np.array(Image.open(BytesIO(base64.b64decode(each))).convert("RGB")) for each in data]
    assert max(pictures[0].shape) == 480
    assert len({picture.tobytes() for picture in pictures}) == len(pictures)


@pytest.mark.parametrize(
    ("asked", "expected"),
    [
        ({}, range(126)),
        ({"first": 120}, range(120, 126)),
        ({"first": 3, "end": 6}, range(3, 6)),
        ({"every": 50}, [0, 50, 100, 125]),
        ({"first": 10, "every": 40, "end": 100}, [10, 50, 90]),
        ({"first": 126}, []),
    ],
)
def test_long_games_come_in_parts(asked: dict[str, int], expected: range | list[int]) -> None:
    recording = Recording(match="m/0", game=0, **asked)
    told = [step for step in range(126) if recording.wants(step, step == 125)]
    assert told == list(expected)[:MOST_STEPS]


@pytest.mark.parametrize("every", [1, 2, 3, 7])
@pytest.mark.parametrize("length", range(90, 1000, 13))
def test_no_part_is_longer_than_what_is_allowed(length: int, every: int) -> None:
    recording = Recording(match="m/0", game=0, every=every)
    assert sum(recording.wants(step, step == length) for step in range(length + 1)) <= MOST_STEPS


def test_who_forfeited_is_told(registry: Registry) -> None:
    examples.publish(registry, examples.graph(faulty=True))
    evaluate(LEAGUE, ["tictactoe@1", "tictactoe@2"], registry=registry, blocks=8)
    match, number = next(
        (match, number)
        for match in Ledger(registry).matches(league=LEAGUE)
        for number, game in enumerate(match.games)
        if game.forfeits
    )
    book = leafed(registry, match, number)
    (forfeit,) = book.forfeits
    assert (forfeit["ref"], forfeit["reason"], book.cast[forfeit["agent"]]) == (
        "tictactoe@2",
        "illegal_action",
        "tictactoe@2",
    )
    assert book.fault is None


def test_a_game_that_cannot_be_played_again_says_why(registry: Registry) -> None:
    match = played(registry)
    registry.register(
        examples.config(environment={"entry_point": "tests.evaluation.hanging:Raising"}),
        registry.league(LEAGUE).interface,
    )
    book = leafed(registry, match)
    assert (book.steps, book.length, book.returns) == ((), 0, {})
    assert "played in another environment" in str(book.fault)


def test_what_the_replay_asks_is_what_the_policy_answers(registry: Registry) -> None:
    match = played(registry, LEAGUE, "tictactoe@1", "script:random")
    show = recorded(match.id, 0, registry, chances=True)
    policy = OnnxPolicy(examples.graph(wins=True))
    for moment in show.play(stepping(show.config.environment, 1)):
        for move in moment.moves:
            if move.dist_inputs is not None:
                batch = {name: array[np.newaxis] for name, array in move.observation.items()}
                expected = policy.distribution(batch).dist_inputs
                assert expected is not None
                np.testing.assert_array_equal(move.dist_inputs, expected[0])
