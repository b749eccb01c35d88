"""The tutorial works as written, up to the champion: its files are saved and its commands are run, in order."""

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
