from pathlib import Path

from PIL import Image

from evaluation.matches.game_records import forfeits
from league.registry.registry import Registry
from league.results.ledger import Ledger
from tests.support.command import League
from tests.support.leagues import tictactoe
from tests.support.policies.illegal_action_graph import illegal_action_graph


def test_a_game_is_rendered_and_described(league: League, registry: Registry, tmp_path: Path) -> None:
    out = tmp_path / "game.gif"
    result = league("replay", "tictactoe@3", "script:one_ply", "--side", "player_2", "--out", str(out))
    assert result.code == 0, result.err
    assert "player_1 (script:one_ply)" in result.out
    assert "player_2 (tictactoe@3)" in result.out
    with Image.open(out) as image:
        assert f"{image.n_frames - 1} steps" in result.out  # type: ignore[attr-defined]


def test_a_recorded_match_is_rendered(league: League, registry: Registry, tmp_path: Path) -> None:
    league("evaluate", "tictactoe", "tictactoe@1", "--blocks", "1", "--workers", "0")
    match = Ledger(registry).matches(league="tictactoe")[0]
    result = league("replay", "--match", match.id, "--game", "1", "--out", str(tmp_path / "game.webp"))
    assert result.code == 0, result.err
    assert f"player_1 ({match.contestants[match.games[1].sides[0]]})" in result.out


def test_a_forfeited_game_is_rendered_until_the_forfeit(league: League, registry: Registry, tmp_path: Path) -> None:
    tictactoe.publish(registry, illegal_action_graph(crashes=False))
    (faulty,) = (
        version.ref for version in registry.versions.all("tictactoe") if version.aliases == () and version.number > 3
    )
    result = league("evaluate", "tictactoe", faulty, "--blocks", "4", "--workers", "0")
    matches = Ledger(registry).matches(league="tictactoe")
    assert f"{faulty} forfeited {forfeits(matches, faulty)} games" in result.err
    match, index = next((m, i) for m in matches for i, game in enumerate(m.games) if game.forfeits)
    result = league("replay", "--match", match.id, "--game", str(index), "--out", str(tmp_path / "game.webp"))
    assert result.code == 0, result.err
    assert f"forfeited by {faulty} as {match.games[index].forfeits[0].agent}: illegal action (action" in result.out
    assert "max-frames" not in result.out


def test_invalid_arguments_are_one_sentence(league: League, registry: Registry, tmp_path: Path) -> None:
    result = league("replay", "--out", str(tmp_path / "game.gif"))
    assert (result.code, result.err.count("\n")) == (2, 1)
    assert "expected a contestant" in result.err
    both = league("replay", "tictactoe@1", "--match", "x/0")
    assert both.code == 2
    assert "remove tictactoe@1" in both.err
