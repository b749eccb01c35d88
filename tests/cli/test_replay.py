from pathlib import Path

from PIL import Image

from evaluation.forfeits import forfeits
from league.registry.registry import Registry
from league.results.ledger import Ledger
from tests.cli.conftest import League
from tests.evaluation import examples
from tests.evaluation.test_forfeits import reckless


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


def test_a_forfeited_game_is_filmed_up_to_there_and_told_so(league: League, registry: Registry, tmp_path: Path) -> None:
    examples.publish(registry, reckless(crashes=False))
    (bad,) = (version.ref for version in registry.versions("tictactoe") if version.aliases == () and version.number > 3)
    told = league("evaluate", "tictactoe", bad, "--blocks", "4", "--workers", "0")
    matches = Ledger(registry).matches(league="tictactoe")
    assert f"{bad} forfeited {forfeits(matches, bad)} games" in told.err
    match, index = next((m, i) for m in matches for i, game in enumerate(m.games) if game.forfeits)
    told = league("replay", "--match", match.id, "--game", str(index), "--out", str(tmp_path / "game.webp"))
    assert told.code == 0, told.err
    assert f"forfeited by {bad} as {match.games[index].forfeits[0].agent}: illegal action" in told.out
    assert "max-frames" not in told.out


def test_what_cannot_be_shown_is_one_sentence(league: League, registry: Registry, tmp_path: Path) -> None:
    told = league("replay", "--out", str(tmp_path / "game.gif"))
    assert (told.code, told.err.count("\n")) == (2, 1)
    assert "name who plays" in told.err
    both = league("replay", "tictactoe@1", "--match", "x/0")
    assert both.code == 2
    assert "leave out tictactoe@1" in both.err
