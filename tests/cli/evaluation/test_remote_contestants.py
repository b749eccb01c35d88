"""A version that another server serves is a contestant of all commands, by its URL."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from PIL import Image

from league.registry.aliases import ANY
from league.registry.registry import Registry
from league.results.ledger import Ledger
from league.settings import Storage
from serve_app.runtime.launch import running
from tests.support.command import League
from tests.support.leagues import tictactoe

pytestmark = pytest.mark.slow
STRONG, WEAK = 1, 2
"""Versions of the other league."""


@dataclass(frozen=True)
class Other:
    """The server of another league: the URL of its model, and its registry."""

    model: str
    registry: Registry

    def version(self, number: int) -> str:
        return f"{self.model}/versions/{number}"


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Other]:
    registry = tictactoe.registry(Storage.at(tmp_path_factory.mktemp("other")).home)
    for graph in (tictactoe.graph(wins=True, blocks=True, order=tictactoe.CENTRE_FIRST), tictactoe.graph()):
        tictactoe.publish(registry, graph)
    promote(registry, STRONG)
    with running(registry.storage, replicas=1) as url:
        yield Other(f"{url}/v2/models/tictactoe", registry)
    registry.close()


def promote(registry: Registry, version: int) -> None:
    registry.aliases.set("tictactoe", "champion", version, expected=ANY, actor="test", reason="to serve it")


@pytest.mark.parametrize("workers", ["0", "2"])
def test_it_is_evaluated_by_its_version(
    league: League, league_process: League, registry: Registry, other: Other, workers: str
) -> None:
    run = league if workers == "0" else league_process
    result = run("evaluate", "tictactoe", "tictactoe@1", other.model, "--blocks", "8", "--workers", workers, "--json")
    assert result.code == 0, result.err
    scores = {row["ref"]: row["score"] for row in result.json["leaderboard"]}
    assert scores[other.version(STRONG)] > scores["tictactoe@1"]
    again = run(
        "evaluate", "tictactoe", "tictactoe@1", other.version(STRONG), "--blocks", "8", "--workers", workers, "--json"
    )
    assert again.json["leaderboard"] == result.json["leaderboard"], "the same contestant: no game was played again"


def test_another_version_is_another_contestant(league: League, registry: Registry, other: Other) -> None:
    result = league(
        "evaluate", "tictactoe", other.model, other.version(WEAK), "--blocks", "8", "--workers", "0", "--json"
    )
    assert result.code == 0, result.err
    assert {other.version(STRONG), other.version(WEAK)} <= {row["ref"] for row in result.json["leaderboard"]}


def test_a_candidate_that_loses_to_it_is_not_promoted(league: League, home: Path, other: Other) -> None:
    registry = tictactoe.registry(home, gate={"anchors": [{"ref": other.model, "margin": 40}], "earlier_champions": 0})
    for graph in (tictactoe.graph(), tictactoe.graph(blocks=True)):
        tictactoe.publish(registry, graph)
    promote(registry, 1)
    result = league("nightly", "tictactoe", "--workers", "0", "--json")
    assert result.code == 0, result.err
    (verdict,) = result.json["leagues"][0]["verdicts"]
    (anchor,) = verdict["anchors"]
    assert (anchor["ref"], anchor["outcome"], verdict["outcome"]) == (other.version(STRONG), "inferior", "reject")
    assert registry.aliases.current("tictactoe")["champion"] == 1
    assert other.version(STRONG) in (home / "reports" / "tictactoe.html").read_text()


def test_its_games_are_rendered(league: League, registry: Registry, other: Other, tmp_path: Path) -> None:
    out = tmp_path / "game.gif"
    result = league("replay", "tictactoe@1", other.model, "--out", str(out))
    assert result.code == 0, result.err
    assert f"player_2 ({other.version(STRONG)})" in result.out
    with Image.open(out) as image:
        assert f"{image.n_frames - 1} steps" in result.out  # type: ignore[attr-defined]
    league("evaluate", "tictactoe", "tictactoe@1", other.model, "--blocks", "1", "--workers", "0")
    match = next(
        each for each in Ledger(registry).matches(league="tictactoe") if other.version(STRONG) in each.contestants
    )
    recorded = league("replay", "--match", match.id, "--out", str(tmp_path / "recorded.gif"))
    assert recorded.code == 0, recorded.err
    assert other.version(STRONG) in recorded.out


def test_an_evaluation_ends_if_the_server_is_gone(league: League, registry: Registry) -> None:
    result = league("evaluate", "tictactoe", "tictactoe@1", "http://127.0.0.1:9/v2/models/tictactoe")
    assert result.code == 1
    assert "http://127.0.0.1:9/v2/models/tictactoe cannot be reached" in result.err
    assert result.err.count("\n") == 1
