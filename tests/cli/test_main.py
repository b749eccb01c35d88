import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from league.registry.registry import Registry
from policy_league.cli import main
from policy_league.cli.main import SUBCOMMANDS, app
from tests.support.command import League

COMMANDS = typer.main.get_command(app).commands  # type: ignore[attr-defined]


def test_the_commands_are_complete() -> None:
    assert set(COMMANDS) == {
        "doctor", "check-env", "train", "sweep", "versions", "note", "evaluate", "promote", "rollback", "history",
        "nightly", "replay", "serve", "act", "demo", "replicas", "keys", "traffic", "verify", "void", "report",
        "retire", "import", "export", "exploitability", "list", "archive", "remove", "compare", "init", "runs",
        "mixture", "recount", "export-games", "search",
    }  # fmt: skip


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_each_command_and_option_has_help(name: str) -> None:
    command = COMMANDS[name]
    assert command.help
    assert len(command.help) > 40
    for part in (command, *getattr(command, "commands", {}).values()):
        assert part.help, f"{name} {part.name} has no help"
        for parameter in part.params:
            if parameter.name != "help":
                assert getattr(parameter, "help", None), f"{name} {parameter.name} has no help"


@pytest.mark.parametrize(
    ("arguments", "messages"),
    [
        (("versions", "chess"), ("no league 'chess'", "tictactoe")),
        (("versions", "A/B"), ("'A/B' must consist of",)),
        (("promote", "tictactoe@9", "--yes"), ("tictactoe", "9")),
        (("promote", "tictactoe@champion", "--yes"), ("champion",)),
        (("promote", "tictactoe"), ("contains no version",)),
        (("promote", "tictactoe@1", "--yes", "--alias", "12"), ("version number",)),
        (("promote", "tictactoe@1", "--yes", "--expected", "x"), ("--expected",)),
        (("history", "tictactoe", "--at", "noon"), ("--at 'noon'",)),
        (("train", "tictactoe", "--against", "@1"), ("--role exploiter", "--against")),
        (("evaluate", "tictactoe", "connect_four@1"), ("connect_four@1",)),
        (("evaluate", "tictactoe", "script:stockfish"), ("stockfish",)),
        (("evaluate", "tictactoe", "--against", "tictactoe@1"), ("against", "gauntlet")),
        (("evaluate", "tictactoe", "--minutes", "0"), ("minutes", "got 0")),
        (("evaluate", "tictactoe", "--precision", "-5"), ("precision", "got -5")),
        (("evaluate", "tictactoe", "--schedule", "cross_play"), ("cross-play", "2 side(s)")),
        (("nightly", "nowhere.yaml"), ("nowhere.yaml: No such file",)),
        (("train", "nowhere.yaml"), ("nowhere.yaml: No such file",)),
        (("act", "script:random"), ("script",)),
        (("act", "tictactoe@1", "--local", "-o", "[[["), ("not valid JSON",)),
        (("act", "tictactoe@1", "--local", "-o", '{"observation": [[1]]}'), ("action_mask",)),
        (("act", "tictactoe@1", "--local", "--policy", "other"), ("other",)),
    ],
)
def test_a_usage_error_is_one_line_and_exits_with_2(
    league: League, registry: Registry, arguments: tuple[str, ...], messages: tuple[str, ...]
) -> None:
    result = league(*arguments)
    assert result.code == 2, result.err
    assert result.out == ""
    assert result.err.count("\n") == 1
    assert result.err.startswith("league: ")
    for word in messages:
        assert word in result.err


@pytest.mark.usefixtures("registry")
def test_a_cluster_that_does_not_exist_is_a_usage_error(league_process: League) -> None:
    """In a subprocess, since a process that is connected to Ray already does not connect again."""
    result = league_process("evaluate", "tictactoe", "--address", "127.0.0.1:1")
    assert (result.code, result.out) == (2, "")
    assert result.err.startswith("league: no Ray cluster at '127.0.0.1:1'")
    assert result.err.count("\n") == 1


def test_an_unusable_home_is_reported_in_one_line(league: League, home: Path) -> None:
    home.write_text("a file, where a directory is wanted")
    result = league("versions", "tictactoe")
    assert result.code == 1
    assert result.err.count("\n") == 1
    assert "home" in result.err


@pytest.mark.parametrize("folder", ["configs", "training", "evaluation", "league"])
def test_a_folder_with_the_name_of_a_package_does_no_harm(
    league_process: League, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: str
) -> None:
    (tmp_path / folder).mkdir()
    monkeypatch.chdir(tmp_path)
    result = league_process("train", "--help")
    assert (result.code, result.err) == (0, "")


@pytest.mark.parametrize("name", sorted(SUBCOMMANDS))
def test_the_listed_help_of_a_command_is_the_first_paragraph_of_its_help(name: str) -> None:
    own = COMMANDS[name].help.partition("\n\n")[0]
    assert SUBCOMMANDS[name].help == own.replace("\n", " ")


LARGE_PACKAGES = (
    "alembic",
    "gymnasium",
    "httpx",
    "league.config.league",
    "numpy",
    "onnxruntime",
    "pettingzoo",
    "ray",
    "scipy",
    "sqlalchemy",
    "torch",
)


def test_help_imports_no_large_package() -> None:
    program = f"""if True:
        import sys
        from typer.testing import CliRunner
        from policy_league.cli.main import SUBCOMMANDS, app
        for arguments in ([], *([name] for name in SUBCOMMANDS)):
            done = CliRunner().invoke(app, [*arguments, "--help"])
            assert done.exit_code == 0, done.output
        print(sorted(sys.modules.keys() & set({LARGE_PACKAGES})))
    """
    assert _last_line(program) == "[]"


def test_the_versions_of_a_league_without_games_are_listed_without_numpy(home: Path, registry: Registry) -> None:
    program = f"""if True:
        import sys
        from typer.testing import CliRunner
        from policy_league.cli.main import app
        done = CliRunner().invoke(app, ["versions", "tictactoe"])
        assert done.exit_code == 0, done.output
        print(sorted(sys.modules.keys() & ({set(LARGE_PACKAGES)} - {{"sqlalchemy"}})))
    """
    assert _last_line(program, LEAGUE_HOME=str(home)) == "[]"


def _last_line(program: str, **environment: str) -> str:
    """Run a program in a process of its own and return the last line that it prints."""
    done = subprocess.run(
        [sys.executable, "-c", program],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    return done.stdout.splitlines()[-1]


def test_json_is_alone_on_stdout_although_the_environment_prints(league_process: League, tmp_path: Path) -> None:
    (tmp_path / "talkative.py").write_text("from pettingzoo.classic.tictactoe_v3 import env\n\nprint('hello')\n")
    config = tmp_path / "talkative.yaml"
    config.write_text("league: talkative\nenvironment: {entry_point: 'talkative:env'}\n")
    result = league_process("check-env", str(config), "--json")
    assert result.json["policies"], result.out
    assert "hello" in result.err


def test_code_of_a_user_does_not_end_a_command_silently(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(main, "app", lambda: sys.exit(0))
    with pytest.raises(SystemExit) as end:
        main.run()
    assert end.value.code == 1
    assert re.fullmatch(rf"league: {re.escape(__file__)}, line \d+ called sys\.exit\(\)\n", capsys.readouterr().err)
