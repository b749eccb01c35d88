from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageColor

from evaluation.matches.tournament import evaluate
from evaluation.playback.environment_hooks import KNOWN
from evaluation.playback.replay import GameSource, live_game, recorded_game
from evaluation.playback.video import FrameComposer, show_window, write_video
from league.config.league import LeagueConfig
from league.environments import building
from league.environments.building import interface
from league.errors import ConfigError, EnvironmentMismatch, InvalidReference, NotFound, StorageError
from league.interface import AgentInterface
from league.registry.registry import Registry
from league.results.ledger import Ledger
from league.spaces import Box, Discrete
from tests.support.leagues import tictactoe

SIMULTANEOUS = "tests.support.environments.simultaneous:meeting"


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    """Tic-tac-toe with two versions."""
    opened = tictactoe.registry(tmp_path / "home")
    for graph in (tictactoe.graph(), tictactoe.graph(wins=True)):
        tictactoe.publish(opened, graph)
    yield opened
    opened.close()


def register(registry: Registry, name: str, entry_point: str, **parts: Any) -> None:
    config = LeagueConfig.from_mapping({"league": name, "environment": {"entry_point": entry_point}} | parts)
    league_interface = interface(config)
    registry.leagues.register(config, league_interface)
    tictactoe.publish(registry, tictactoe.linear(league_interface.of_policy("shared"), 1), name)


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
    out = tmp_path / f"game{suffix}"
    captions: list[str] = []
    result = write_video(
        live_game(["tictactoe@2", "script:one_ply"], registry),
        out,
        listener=lambda caption: captions.append(caption.step),
    )
    size, frames, durations = read_video(out)
    assert result.is_whole
    assert captions == ["start", *(f"step {i}" for i in range(1, result.steps)), f"step {result.steps} · end"]
    assert len(frames) == result.steps + 1
    assert size[0] == 640
    assert durations[:-1] == [500] * result.steps
    if suffix == ".gif":
        assert durations[-1] == 2000
    assert sum(result.returns.values()) == 0
    assert len({frame.tobytes() for frame in frames}) == len(frames), "all frames differ"


def test_the_legend_of_a_gif_has_the_colours_of_the_marks(registry: Registry, tmp_path: Path) -> None:
    write_video(live_game(["tictactoe@2", "script:one_ply"], registry), tmp_path / "game.gif")
    _, frames, _ = read_video(tmp_path / "game.gif")
    colors = KNOWN["tictactoe_v3"]["agent_colors"].values()
    for frame in (frames[0], frames[-1]):
        legend = np.array(frame.crop((10, frame.height - 70, 28, frame.height))).reshape(-1, 3).astype(int)
        assert [abs(legend - ImageColor.getrgb(color)).max(axis=1).min() < 16 for color in colors] == [True, True]


def test_simultaneous_agents_have_a_frame_for_each_step(registry: Registry, tmp_path: Path) -> None:
    register(registry, "spread", "mpe2.simple_spread_v3", sides={"team": ["*"]})
    result = write_video(live_game(["spread@1"], registry, seed=4), tmp_path / "spread.gif")
    _, frames, durations = read_video(tmp_path / "spread.gif")
    assert result.steps == 25
    assert len(frames) == 26
    assert set(durations[:-1]) == {100}


def test_the_length_of_a_video_is_limited(registry: Registry, tmp_path: Path) -> None:
    result = write_video(live_game(["tictactoe@1"], registry), tmp_path / "short.gif", max_frames=3, fps=4)
    _, frames, durations = read_video(tmp_path / "short.gif")
    assert (result.steps, result.is_whole) == (2, False)
    assert (len(frames), durations[:2]) == (3, [250, 250])


def test_a_recorded_match_is_shown_as_played(registry: Registry, tmp_path: Path) -> None:
    evaluate("tictactoe", ["tictactoe@1", "tictactoe@2"], registry=registry, blocks=2)
    match = Ledger(registry).matches(league="tictactoe")[1]
    for index, game in enumerate(match.games):
        source = recorded_game(match.id, index, registry)
        assert list(source.controllers.values()) == [match.contestants[number] for number in game.sides]
        done = write_video(source, tmp_path / "match.gif")
        assert done.is_whole
        assert done.steps == len(game.opening) + len(game.actions)
        assert {source.controllers[agent]: value for agent, value in done.returns.items()} == dict(
            zip(match.contestants, game.returns, strict=True)
        )
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
    registry.aliases.set("tictactoe", "champion", 1, expected=None, actor="me", reason="first")
    assert controllers("tictactoe@champion") == ["tictactoe@1", "tictactoe@1"]


@pytest.mark.parametrize(
    ("refs", "side", "message"),
    [
        (["script:random"], None, "at least one version"),
        (["tictactoe@1"] * 3, None, r"3 contestants for 2 side\(s\): player_1, player_2"),
        (["tictactoe@1"], "player_0", "unknown side 'player_0'; known: player_1, player_2"),
    ],
)
def test_invalid_contestants_are_rejected(registry: Registry, refs: list[str], side: str | None, message: str) -> None:
    with pytest.raises(InvalidReference, match=message):
        live_game(refs, registry, side)


def test_an_environment_without_rendering_is_rejected(registry: Registry, tmp_path: Path) -> None:
    config = LeagueConfig.from_mapping(
        {"league": "meeting", "environment": {"entry_point": SIMULTANEOUS}, "policies": {"a": ["agent_0"], "b": ["*"]}}
    )
    league_interface = interface(config)
    source = GameSource(
        "meeting", config, league_interface, dict.fromkeys(league_interface.agents, "script:random"), lambda _: iter(())
    )
    with pytest.raises(EnvironmentMismatch, match=r"has no render_mode 'rgb_array' \(it has none\)"):
        write_video(source, tmp_path / "game.gif")


def test_another_video_format_is_rejected(registry: Registry, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"game\.mp4: expected a name that ends in \.gif or \.webp"):
        write_video(live_game(["tictactoe@1"], registry), tmp_path / "game.mp4")


def test_a_video_that_cannot_be_written_leaves_no_file(registry: Registry, tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="cannot be written"):
        write_video(live_game(["tictactoe@1"], registry), tmp_path / "nowhere" / "game.gif")
    (tmp_path / "game.gif").mkdir()
    with pytest.raises(StorageError, match="cannot be written"):
        write_video(live_game(["tictactoe@1"], registry), tmp_path / "game.gif")
    assert [path.name for path in tmp_path.iterdir() if path.name not in ("home", "game.gif")] == []


def test_a_window_needs_a_display(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(EnvironmentMismatch, match="--watch needs a display"):
        show_window(live_game(["tictactoe@1"], registry))


@pytest.mark.parametrize(
    ("height", "width", "expected"),
    [(1000, 550, (352, 640)), (560, 880, (640, 407)), (480, 480, (480, 480)), (20, 30, (300, 200))],
)
def test_images_are_scaled_to_a_suitable_size(height: int, width: int, expected: tuple[int, int]) -> None:
    image = np.zeros((height, width, 3), np.uint8)
    assert FrameComposer(image, 2)._picture == expected
