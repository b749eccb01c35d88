"""The tutorial works as written, up to the champion: its files are saved and its commands are run, in order."""

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

PAGE = Path(__file__).parent.parent / "docs/tutorial.md"


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE.read_text(), flags=re.S | re.M)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_tutorial_leads_to_a_champion(tmp_path: Path) -> None:
    game, bot, _ = blocks("python")
    (tmp_path / "nim.py").write_text(game)
    (tmp_path / "nim_bot.py").write_text(bot)
    (tmp_path / "nim.yaml").write_text(blocks("yaml")[0])
    environment = os.environ | {"LEAGUE_HOME": str(tmp_path / "home")}
    printed = []
    for line in blocks("sh")[0].splitlines():
        command = [str(Path(sys.executable).with_name("league")), *shlex.split(line)[1:]]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{line}\n{done.stdout}{done.stderr}"
        printed.append(done.stdout)
    assert "the champion is now nim@1" in printed[2]
    assert (tmp_path / "game.gif").stat().st_size > 0
    again = crontab_command(tmp_path, league=Path(sys.executable).with_name("league")).replace(" --train", "")
    assert subprocess.run(["/bin/sh", "-c", again], cwd="/", env={"PATH": "/usr/bin:/bin"}, check=False).returncode == 0
    assert "the champion is still nim@1" in (tmp_path / "nightly.log").read_text()


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
    assert (tmp_path / "nightly.log").read_text() == f"{tmp_path / 'home'} nightly --train nim\n"


def test_the_calls_in_all_languages_are_the_same() -> None:
    """Path, observation and mask. Brackets match."""
    programs = [blocks("python")[2], *blocks("js"), *blocks("csharp")]
    stones = [0] * 10 + [1]
    for program in programs:
        assert all(program.count(left) == program.count(right) for left, right in ("()", "[]", "{}"))
        assert "http://127.0.0.1:8000" in program
    for program in programs[1:]:
        assert "/v1/policies/nim/action" in program
        numbers = [json.loads(f"[{found}]") for found in re.findall(r"[\[{] ?((?:[01], )+[01]) ?[\]}]", program)]
        assert numbers == [stones, [1, 1, 1]]
        assert all(name in program for name in ("observation", "action_mask"))
