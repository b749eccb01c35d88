from pathlib import Path

import pytest
import typer

from cli.main import app
from league.registry.registry import Registry
from tests.cli.conftest import League

COMMANDS = typer.main.get_command(app).commands  # type: ignore[attr-defined]


def test_the_commands_are_those_of_the_mission() -> None:
    assert set(COMMANDS) == {
        "doctor", "check-env", "train", "sweep", "versions", "note", "evaluate", "promote", "rollback", "history",
        "nightly", "replay", "serve", "act", "demo", "keys", "traffic", "verify", "void", "report",
    }  # fmt: skip


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_each_command_and_option_explains_itself(name: str) -> None:
    command = COMMANDS[name]
    assert command.help
    assert len(command.help) > 40
    for part in (command, *getattr(command, "commands", {}).values()):
        assert part.help, f"{name} {part.name} has no help"
        for parameter in part.params:
            if parameter.name != "help":
                assert getattr(parameter, "help", None), f"{name} {parameter.name} has no help"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("versions", "chess"), ("no league 'chess'", "tictactoe")),
        (("versions", "A/B"), ("'A/B' must consist of",)),
        (("promote", "tictactoe@9"), ("tictactoe", "9")),
        (("promote", "tictactoe@champion"), ("champion",)),
        (("promote", "tictactoe"), ("names no version",)),
        (("promote", "tictactoe@1", "--alias", "12"), ("version number",)),
        (("promote", "tictactoe@1", "--expected", "x"), ("--expected",)),
        (("history", "tictactoe", "--at", "noon"), ("--at 'noon'",)),
        (("evaluate", "tictactoe", "connect_four@1"), ("connect_four@1",)),
        (("evaluate", "tictactoe", "script:stockfish"), ("stockfish",)),
        (("evaluate", "tictactoe", "--against", "tictactoe@1"), ("against", "gauntlet")),
        (("evaluate", "tictactoe", "--minutes", "0"), ("minutes", "got 0")),
        (("evaluate", "tictactoe", "--precision", "-5"), ("precision", "got -5")),
        (("evaluate", "tictactoe", "--schedule", "cross_play"), ("cross-play", "2 side(s)")),
        (("evaluate", "tictactoe", "--address", "127.0.0.1:1"), ("no Ray cluster at '127.0.0.1:1'",)),
        (("nightly", "nowhere.yaml"), ("nowhere.yaml: No such file",)),
        (("train", "nowhere.yaml"), ("nowhere.yaml: No such file",)),
        (("act", "script:random"), ("script",)),
        (("act", "tictactoe@1", "--local", "-o", "[[["), ("no JSON",)),
        (("act", "tictactoe@1", "--local", "-o", '{"observation": [[1]]}'), ("action_mask",)),
        (("act", "tictactoe@1", "--local", "--policy", "other"), ("other",)),
    ],
)
def test_a_mistake_is_one_line_that_names_the_thing_and_exits_2(
    league: League, registry: Registry, arguments: tuple[str, ...], words: tuple[str, ...]
) -> None:
    outcome = league(*arguments)
    assert outcome.code == 2, outcome.err
    assert outcome.out == ""
    assert outcome.err.count("\n") == 1
    assert outcome.err.startswith("league: ")
    for word in words:
        assert word in outcome.err


def test_a_home_that_cannot_be_written_is_one_line(league: League, home: Path) -> None:
    home.write_text("a file, where a directory is wanted")
    outcome = league("versions", "tictactoe")
    assert outcome.code == 1
    assert outcome.err.count("\n") == 1
    assert "home" in outcome.err


def test_a_server_that_is_not_there_is_one_line(league: League, registry: Registry) -> None:
    outcome = league("act", "tictactoe@1", "--url", "http://127.0.0.1:9")
    assert outcome.code == 1
    assert outcome.err.count("\n") == 1
    assert "http://127.0.0.1:9" in outcome.err
