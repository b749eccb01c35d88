import base64
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from evaluation.matches.game_records import Upset
from evaluation.matches.tournament import evaluate
from evaluation.reporting import flipbook
from evaluation.reporting.flipbook import Flipbook, flipbooks
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.registry.registry import Registry
from league.results.ledger import Ledger
from league.results.records import Match
from tests.support.leagues import tictactoe
from tests.support.leagues.tictactoe import LEAGUE


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    opened = tictactoe.registry(tmp_path / "home")
    tictactoe.publish(opened, tictactoe.graph())
    yield opened
    opened.close()


def upset(match: Match, game: int = 0) -> Upset:
    return Upset(match.id, game, match.contestants[0], match.contestants[1], 0.1, 1.0)


def play_match(registry: Registry, league: str = LEAGUE, *refs: str, **config: Any) -> Match:
    if config:
        parts = LeagueConfig.from_mapping({"league": league} | config)
        registry.leagues.register(parts, interface(parts))
    evaluate(league, refs, registry=registry, blocks=1)
    return Ledger(registry).matches(league=league)[0]


def images(book: Flipbook) -> list[bytes]:
    kind, data = zip(*(str(step.picture).split(",") for step in book.steps), strict=True)
    assert set(kind) == {"data:image/png;base64"}
    return [Image.open(BytesIO(base64.b64decode(each))).convert("RGB").tobytes() for each in data]


def test_each_step_has_its_moves_and_image(registry: Registry) -> None:
    match = play_match(registry)
    (book,) = flipbooks(registry, LEAGUE, [upset(match, 1)], pictures=True)
    game = match.games[1]
    moves = [*game.opening, *game.actions]
    assert [step.step for step in book.steps] == list(range(len(moves) + 1))
    players = ("player_1", "player_2")
    assert [step.did for step in book.steps] == [
        "start",
        *(f"{players[i % 2]} plays {move}{' (random opening)' * (i < 2)}" for i, move in enumerate(moves)),
    ]
    assert (book.length, book.every, book.fault) == (len(moves), 1, None)
    assert set(book.players.values()) == set(match.contestants)
    assert set(book.returns.values()) == set(game.returns)
    assert len(set(images(book))) == len(book.steps), "all images differ"


def test_a_long_game_keeps_some_steps_with_the_first_and_the_last(
    registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(flipbook, "MOST_STEPS", 10)
    match = play_match(
        registry,
        "spread",
        "script:random",
        "script:first",
        environment={"entry_point": "mpe2.simple_spread_v3", "kwargs": {"max_cycles": 25}},
    )
    (book,) = flipbooks(registry, "spread", [upset(match)], pictures=False)
    assert (book.length, book.every) == (25, 4)
    assert [step.step for step in book.steps] == [0, 4, 8, 12, 16, 20, 24, 25]
    assert {step.picture for step in book.steps} == {None}


def test_the_size_of_images_is_limited(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    match = play_match(registry)
    limit = 20_000
    monkeypatch.setattr(flipbook, "MOST_BYTES", 2 * limit)
    books = flipbooks(registry, LEAGUE, [upset(match, 0), upset(match, 1)], pictures=True)
    for book in books:
        assert book.every > 1
        assert book.steps[-1].step == book.length
        assert sum(len(str(step.picture)) for step in book.steps) <= limit


def test_an_environment_without_rendering_has_text_only(registry: Registry) -> None:
    match = play_match(
        registry,
        "meeting",
        "script:random",
        "script:first",
        environment={"entry_point": "tests.support.environments.simultaneous:meeting"},
        policies={"a": ["agent_0"], "b": ["*"]},
    )
    (book,) = flipbooks(registry, "meeting", [upset(match)], pictures=True)
    assert book.fault is None
    assert {step.picture for step in book.steps} == {None}
    assert "plays" in book.steps[1].did


def test_a_game_that_cannot_be_replayed_has_a_reason_and_the_others_are_shown(registry: Registry) -> None:
    match = play_match(registry)
    missing = Upset("nowhere/0", 0, *match.contestants, 0.1, 1.0)
    lost, found = flipbooks(registry, LEAGUE, [missing, upset(match)], pictures=False)
    assert lost.fault is not None
    assert "nowhere" in lost.fault
    assert (lost.steps, found.fault) == ((), None)
    assert found.steps
