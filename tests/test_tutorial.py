"""The tutorial works as written: its files are saved, its commands are run in order, and its programs call the server.

The program in C# is only compared with the others.
"""

import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from shutil import which

import pytest

from league.settings import Storage
from serve_app.runtime.launch import running
from tests.support.leagues.browser_leagues import answer

PAGE = Path(__file__).parent.parent / "docs/tutorial.md"


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE.read_text(), flags=re.S | re.M)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory of the tutorial after its commands, with a champion."""
    folder = tmp_path_factory.mktemp("tutorial")
    game, bot, _ = blocks("python")
    (folder / "nim.py").write_text(game)
    (folder / "nim_bot.py").write_text(bot)
    (folder / "nim.yaml").write_text(blocks("yaml")[0])
    environment = os.environ | {"LEAGUE_HOME": str(folder / "league-home")}
    printed = []
    for line in blocks("sh")[0].splitlines():
        command = [str(Path(sys.executable).with_name("league")), *shlex.split(line)[1:]]
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{line}\n{done.stdout}{done.stderr}"
        printed.append(done.stdout)
    assert "the champion is now nim@1" in printed[2]
    assert (folder / "game.gif").stat().st_size > 0
    return folder


@pytest.fixture(scope="module")
def url(folder: Path) -> Iterator[str]:
    with running(Storage.at(folder / "league-home"), replicas=1) as url:
        yield url


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    ("suffix", "program"),
    [(".py", [sys.executable]), (".mjs", [which("node") or "node"])],
    ids=["Python", "JavaScript"],
)
def test_the_programs_call_the_server(url: str, tmp_path: Path, suffix: str, program: list[str]) -> None:
    if not which(program[0]):
        pytest.skip("Node is not installed")
    text = blocks("python")[2] if suffix == ".py" else blocks("js")[0]
    path = tmp_path / f"call{suffix}"
    path.write_text(text.replace("http://127.0.0.1:8000", url))
    done = subprocess.run([*program, str(path)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) in (0, 1, 2)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_person_plays_against_the_version(url: str) -> None:
    """The code of the game is found, although the server was started in another directory."""
    game = answer("POST", f"{url}/v1/leagues/nim/play", {"opponent": "nim@1", "agent": "first", "actions": [1]})
    moves = [(move["agent"], move["ref"]) for step in game["steps"] for move in step["moves"]]
    assert moves[:2] == [("first", "person"), ("second", "nim@1")]
    assert game["picture"].startswith("data:image/png")


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_line_of_the_crontab_trains_a_night(folder: Path) -> None:
    short = blocks("yaml")[0].replace("gate:\n", "gate:\n  max_blocks: 50\n")
    (folder / "nim.yaml").write_text(f"{short}nightly: {{steps: 1000, exploiter: 0}}\n")
    command = crontab_command(folder, league=Path(sys.executable).with_name("league"))
    done = subprocess.run(["/bin/sh", "-c", command], cwd="/", env={"PATH": "/usr/bin:/bin"}, check=False)
    log = (folder / "nightly.log").read_text()
    assert done.returncode == 0, log
    # In a LEAGUE_HOME of its own, so that there is no champion yet.
    assert "nim: night 1 trained nim@1 from scratch." in log
    assert "nim: 1 tested" in log


def crontab_command(folder: Path, league: Path) -> str:
    """The command of the crontab's line, adapted as the page says."""
    *_, command = blocks("crontab")[0].strip().split(maxsplit=5)
    command = command.replace("/home/ann/nim/league-home", str(folder / "home")).replace("/home/ann/nim", str(folder))
    return command.replace(" league nightly", f" {league} nightly")


def test_the_line_of_the_crontab_is_well_formed(tmp_path: Path) -> None:
    """Five fields of time, and a command that names a subcommand and its options. Cron would replace each %."""
    (line,) = blocks("crontab")[0].splitlines()
    assert re.fullmatch(r"(\d+|\*) (\d+|\*) \* \* \* cd /\S+ && LEAGUE_HOME=/\S+ league nightly .*", line)
    assert "%" not in line
    tool = tmp_path / "tool"
    tool.write_text('#!/bin/sh\necho "$LEAGUE_HOME" "$@"\n')
    tool.chmod(0o700)
    subprocess.run(["/bin/sh", "-c", crontab_command(tmp_path, tool)], cwd="/", check=True)
    assert (tmp_path / "nightly.log").read_text() == f"{tmp_path / 'home'} nightly --train nim.yaml\n"


def test_the_calls_in_all_languages_are_the_same() -> None:
    """Path, observation and mask. Brackets match."""
    programs = [blocks("python")[2], *blocks("js"), *blocks("csharp")]
    stones = [0] * 10 + [1]
    for program in programs:
        assert all(program.count(left) == program.count(right) for left, right in ("()", "[]", "{}"))
        assert "http://127.0.0.1:8000" in program
    for program in programs[1:]:
        assert "/v1/policies/nim/action" in program
        numbers = [json.loads(f"[{items}]") for items in re.findall(r"[\[{] ?((?:[01], )+[01]) ?[\]}]", program)]
        assert numbers == [stones, [1, 1, 1]]
        assert all(name in program for name in ("observation", "action_mask"))
