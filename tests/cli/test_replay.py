from pathlib import Path

from PIL import Image

from league.registry.registry import Registry
from league.results.ledger import Ledger
from tests.cli.conftest import League


def test_a_game_is_filmed_and_told(league: League, registry: Registry, tmp_path: Path) -> None:
    out = tmp_path / "game.gif"
    told = league("replay", "tictactoe@3", "script:one_ply", "--side", "player_2", "--out", str(out))
    assert told.code == 0, told.err
    assert "player_1 (script:one_ply)" in told.out
    assert "player_2 (tictactoe@3)" in told.out
    with Image.open(out) as film:
        assert f"{film.n_frames - 1} steps" in told.out  # type: ignore[attr-defined]


def test_a_recorded_match_is_filmed(league: League, registry: Registry, tmp_path: Path) -> None:
    league("evaluate", "tictactoe", "tictactoe@1", "--blocks", "1", "--workers", "0")
    match = Ledger(registry).matches(league="tictactoe")[0]
    told = league("replay", "--match", match.id, "--game", "1", "--out", str(tmp_path / "game.webp"))
    assert told.code == 0, told.err
    assert f"player_1 ({match.contestants[match.games[1].sides[0]]})" in told.out


def test_what_cannot_be_shown_is_one_sentence(league: League, registry: Registry, tmp_path: Path) -> None:
    told = league("replay", "--out", str(tmp_path / "game.gif"))
    assert (told.code, told.err.count("\n")) == (2, 1)
    assert "name who plays" in told.err
    both = league("replay", "tictactoe@1", "--match", "x/0")
    assert both.code == 2
    assert "leave out tictactoe@1" in both.err
