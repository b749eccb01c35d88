from pathlib import Path

import pytest

from league.registry.registry import Registry
from tests.support.command import League


def test_a_league_is_reported_on_one_page(
    league: League, registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    league("evaluate", "tictactoe", "--blocks", "4", "--workers", "0")
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[3]))
    monkeypatch.chdir(tmp_path)
    result = league("report", "tictactoe")
    assert result.code == 0, result.err
    assert result.out.startswith("tictactoe-report.html: 80 games, 0 verdicts, ")
    assert (tmp_path / "tictactoe-report.html").read_text(encoding="utf-8").startswith("<!doctype html>")
    elsewhere = league("report", "tictactoe", "--out", str(tmp_path / "page.html"))
    assert elsewhere.code == 0
    assert (tmp_path / "page.html").exists()


def test_the_report_can_be_a_json_document(league: League, registry: Registry, tmp_path: Path) -> None:
    league("evaluate", "tictactoe", "--blocks", "4", "--workers", "0")
    document = league("report", "tictactoe", "--json").json
    assert (document["league"], document["games"], len(document["versions"])) == ("tictactoe", 80, 3)
    assert document["leaderboard"][0]["rank"] == 1
    assert {step["picture"] for game in document["upsets"] for step in game["steps"]} <= {None}


def test_invalid_arguments_are_one_sentence(league: League, registry: Registry, tmp_path: Path) -> None:
    for arguments, code, message in (
        (("chess",), 2, "chess"),
        (("tictactoe", "--json", "--out", "page.html"), 2, "cannot be combined with --out page.html"),
        (("tictactoe", "--out", str(tmp_path / "nowhere" / "page.html")), 1, "cannot be written"),
    ):
        result = league("report", *arguments)
        assert (result.code, result.err.count("\n")) == (code, 1), result.err
        assert message in result.err
