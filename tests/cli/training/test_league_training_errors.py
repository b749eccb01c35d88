"""Invalid input of league training: one line on stderr, and nothing in the registry changes."""

from pathlib import Path

import pytest

from league.registry.registry import Registry
from tests.support.command import League
from tests.support.leagues import tictactoe

pytestmark = pytest.mark.usefixtures("ray_session")  # `league train` starts a Ray otherwise

OTHER_GAME = """
league: tictactoe
environment: {entry_point: pettingzoo.classic.connect_four_v3}
policies: {shared: ["player_*"]}
training: {steps: 64, opponents: {league: {}}}
"""


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("train {other}", "league tictactoe has versions with other spaces or policies than this configuration"),
        ("nightly {other} --train", "tictactoe: league tictactoe has versions with other spaces or policies than this"),
        ("promote tictactoe@4", "tictactoe@4 has the role exploiter (of tictactoe@3): it cannot be promoted"),
        ("promote tictactoe@3:0.5,@4:0.5", "tictactoe@4 has the role exploiter (of tictactoe@3): it cannot be in a"),
        ("promote tictactoe@3:0.5,@9:0.5", "league tictactoe has no version 9; the newest is 4"),
        (
            "train {own} --role exploiter --against @champion",
            "league tictactoe has no alias 'champion'; known: none yet",
        ),
        ("exploitability tictactoe@2", "tictactoe@2 has no exploiters: train one with"),
        ("mixture empty", "expected at least two versions, the league has 0: `league train CONFIG` publishes them"),
    ],
)
def test_it_is_one_line_and_nothing_is_lost(
    league: League, registry: Registry, tmp_path: Path, command: str, message: str
) -> None:
    tictactoe.publish(registry, tictactoe.graph(), exploits="tictactoe@3")
    empty = tictactoe.config().model_copy(update={"league": "empty"})
    registry.leagues.register(empty, registry.leagues.get("tictactoe").interface)
    files = {"other": tmp_path / "other.yaml", "own": tmp_path / "own.yaml"}
    files["other"].write_text(OTHER_GAME)
    files["own"].write_text(OTHER_GAME.replace("connect_four", "tictactoe"))

    def state() -> object:
        return registry.aliases.current("tictactoe"), [row.ref for row in registry.versions.all("tictactoe")]

    before = state()
    result = league(*command.format(**files).split())
    assert result.code in (1, 2)
    assert result.err.startswith(f"league: {message}")
    assert result.err.count("\n") == 1
    assert state() == before
