from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from evaluation.film import film, watch
from evaluation.frames import Frames
from evaluation.shows import Show, between, recorded
from evaluation.tournament import evaluate
from league.config import LeagueConfig
from league.environments.building import interface
from league.errors import ConfigError, EnvironmentMismatch, InvalidReference, NotFound, StorageError
from league.registry.registry import Registry
from league.results.ledger import Ledger
from tests.evaluation import examples

MEETING = "tests.league.environments.simultaneous:meeting"


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    """Tic-tac-toe with two versions."""
    opened = examples.registry(tmp_path / "home")
    for graph in (examples.graph(), examples.graph(wins=True)):
        examples.publish(opened, graph)
    yield opened
    opened.close()


def league(registry: Registry, name: str, entry_point: str, **parts: Any) -> None:
    config = LeagueConfig.from_mapping({"league": name, "environment": {"entry_point": entry_point}} | parts)
    described = interface(config)
    registry.register(config, described)
    examples.publish(registry, examples.linear(described.of_policy("shared"), 1), name)


def shown(path: Path) -> tuple[tuple[int, int], list[Image.Image], list[int]]:
    with Image.open(path) as pictures:
        frames, durations = [], []
        for index in range(pictures.n_frames):  # type: ignore[attr-defined]
            pictures.seek(index)
            frames.append(pictures.convert("RGB"))
            durations.append(int(pictures.info["duration"]))
        return pictures.size, frames, durations


@pytest.mark.parametrize("suffix", [".gif", ".webp"])
def test_a_game_in_turns_has_a_frame_for_each_move(registry: Registry, tmp_path: Path, suffix: str) -> None:
    out = tmp_path / f"game{suffix}"
    told: list[str] = []
    done = film(
        between(["tictactoe@2", "script:one_ply"], registry), out, listener=lambda caption: told.append(caption.step)
    )
    size, frames, durations = shown(out)
    assert done.is_whole
    assert told == ["start", *(f"step {i}" for i in range(1, done.steps)), f"step {done.steps} · end"]
    assert len(frames) == done.steps + 1
    assert size[0] == 640
    assert durations[:-1] == [500] * done.steps
    if suffix == ".gif":
        assert durations[-1] == 2000
    assert sum(done.returns.values()) == 0
    assert len({frame.tobytes() for frame in frames}) == len(frames), "each frame shows something new"


def test_where_all_act_at_once_there_is_a_frame_for_each_step(registry: Registry, tmp_path: Path) -> None:
    league(registry, "spread", "mpe2.simple_spread_v3", sides={"team": ["*"]})
    done = film(between(["spread@1"], registry, seed=4), tmp_path / "spread.gif")
    _, frames, durations = shown(tmp_path / "spread.gif")
    assert done.steps == 25
    assert len(frames) == 26
    assert set(durations[:-1]) == {100}


def test_a_film_is_as_long_as_it_may_be(registry: Registry, tmp_path: Path) -> None:
    done = film(between(["tictactoe@1"], registry), tmp_path / "short.gif", max_frames=3, fps=4)
    _, frames, durations = shown(tmp_path / "short.gif")
    assert (done.steps, done.is_whole) == (2, False)
    assert (len(frames), durations[:2]) == (3, [250, 250])


def test_a_recorded_match_is_shown_as_it_was_played(registry: Registry, tmp_path: Path) -> None:
    evaluate("tictactoe", ["tictactoe@1", "tictactoe@2"], registry=registry, blocks=2)
    match = Ledger(registry).matches(league="tictactoe")[1]
    for index, game in enumerate(match.games):
        show = recorded(match.id, index, registry)
        assert list(show.cast.values()) == [match.contestants[number] for number in game.sides]
        done = film(show, tmp_path / "match.gif")
        assert done.is_whole
        assert done.steps == len(game.opening) + len(game.actions)
        assert {show.cast[agent]: value for agent, value in done.returns.items()} == dict(
            zip(match.contestants, game.returns, strict=True)
        )
    with pytest.raises(InvalidReference, match="has games 0 to 1, not 2"):
        recorded(match.id, 2, registry)
    for unknown in (f"{match.schedule}/999", f"{match.schedule}/x", "no-such-schedule/0"):
        with pytest.raises(NotFound):
            recorded(unknown, 0, registry)


def test_who_plays_what(registry: Registry) -> None:
    def cast(*refs: str, side: str | None = None) -> list[str]:
        return list(between(refs, registry, side).cast.values())

    assert cast("tictactoe@2") == ["tictactoe@2", "tictactoe@2"]
    assert cast("tictactoe@2", "script:random") == ["tictactoe@2", "script:random"]
    assert cast("tictactoe@2", "script:random", side="player_2") == ["script:random", "tictactoe@2"]
    registry.set_alias("tictactoe", "champion", 1, expected=None, actor="me", reason="first")
    assert cast("tictactoe@champion") == ["tictactoe@1", "tictactoe@1"]


@pytest.mark.parametrize(
    ("refs", "side", "message"),
    [
        (["script:random"], None, "at least one version"),
        (["tictactoe@1"] * 3, None, r"3 were named for 2 side\(s\): player_1, player_2"),
        (["tictactoe@1"], "player_0", "no side 'player_0'; known: player_1, player_2"),
    ],
)
def test_a_cast_that_does_not_fit_is_refused(
    registry: Registry, refs: list[str], side: str | None, message: str
) -> None:
    with pytest.raises(InvalidReference, match=message):
        between(refs, registry, side)


def test_an_environment_without_pictures_is_refused(registry: Registry, tmp_path: Path) -> None:
    config = LeagueConfig.from_mapping(
        {"league": "meeting", "environment": {"entry_point": MEETING}, "policies": {"a": ["agent_0"], "b": ["*"]}}
    )
    described = interface(config)
    show = Show("meeting", config, described, dict.fromkeys(described.agents, "script:random"), lambda _: iter(()))
    with pytest.raises(EnvironmentMismatch, match=r"has no render_mode 'rgb_array' \(it has none\)"):
        film(show, tmp_path / "game.gif")


def test_a_film_of_another_format_is_refused(registry: Registry, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"game\.mp4: expected a name that ends in \.gif or \.webp"):
        film(between(["tictactoe@1"], registry), tmp_path / "game.mp4")


def test_a_film_that_cannot_be_written_leaves_nothing(registry: Registry, tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="cannot be written"):
        film(between(["tictactoe@1"], registry), tmp_path / "nowhere" / "game.gif")
    (tmp_path / "game.gif").mkdir()
    with pytest.raises(StorageError, match="cannot be written"):
        film(between(["tictactoe@1"], registry), tmp_path / "game.gif")
    assert [path.name for path in tmp_path.iterdir() if path.name not in ("home", "game.gif")] == []


def test_a_window_needs_a_display(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(EnvironmentMismatch, match="--watch needs a display"):
        watch(between(["tictactoe@1"], registry))


@pytest.mark.parametrize(
    ("height", "width", "expected"),
    [(1000, 550, (352, 640)), (560, 880, (640, 407)), (480, 480, (480, 480)), (20, 30, (300, 200))],
)
def test_pictures_have_a_sensible_size(height: int, width: int, expected: tuple[int, int]) -> None:
    picture = np.zeros((height, width, 3), np.uint8)
    assert Frames(picture, 2)._picture == expected
