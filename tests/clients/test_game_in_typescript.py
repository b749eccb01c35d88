"""The tutorial with a game in TypeScript works as written: its commands run in order, with another port and home."""

import os
import re
import shutil
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest
import yaml

from league.registry.registry import Registry
from league.settings import Storage
from serve_app.runtime.launch import running
from tests.support.waiting import until

ROOT = Path(__file__).parents[2]
TYPESCRIPT = ROOT / "clients/typescript"
TEXT = (ROOT / "docs/game-in-typescript.md").read_text()
NAME = "connect_four_ts"


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", TEXT, flags=re.S | re.M)


def test_the_page_shows_the_example() -> None:
    """The spaces are those of the file, and the call is that of the game."""
    example = yaml.safe_load((TYPESCRIPT / "examples/connect_four.yaml").read_text())
    assert yaml.safe_load(blocks("yaml")[0])["environment"] == example["environment"]
    game = (TYPESCRIPT / "examples/connect_four.ts").read_text()
    assert "class ConnectFour implements SimulatedGame<number> {" in game
    options = [re.findall(r"(\w+): (\"[^\"]+\"|\d+)", text.partition(".simulate(")[2])[:3] for text in (TEXT, game)]
    assert options[0] == options[1]


@pytest.mark.slow  # installs packages, and trains
@pytest.mark.timeout(1200)
def test_the_commands_lead_to_a_version_that_is_served(tmp_path: Path) -> None:
    if shutil.which("npm") is None:
        (pytest.fail if os.environ.get("CI") else pytest.skip)("npm is not installed")
    install, check, serve, train, simulate, nightly, evaluate, request = blocks("sh")[1:]
    assert serve == "league serve\n"
    if (TYPESCRIPT / "node_modules").is_dir():
        install = install.splitlines()[1]
    storage = Storage.at(tmp_path / "league-home")
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = os.environ | {"LEAGUE_HOME": str(storage.home), "PATH": path}

    def started(script: str, url: str = "") -> subprocess.Popen[str]:
        script = script.replace("league-home/", f"{storage.home}/").replace("http://127.0.0.1:8000", url)
        return subprocess.Popen(
            ["sh", "-ec", script],
            cwd=ROOT,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def ended(process: subprocess.Popen[str]) -> str:
        output, _ = process.communicate()
        assert process.returncode == 0, output
        return output

    ended(started(install))
    assert "The environment passes all checks." in ended(started(check))
    with running(storage, replicas=1) as url, closing(Registry.open(storage)) as registry:
        run = started(train.replace("league train", "exec league train"))
        simulator = None
        try:
            until(lambda: registry.gateways.open(NAME))
            simulator = started(simulate.replace("node ", "exec node ").rstrip() + f" {url}")
            ended(run)
            assert f"the champion is now {NAME}@" in ended(started(nightly))
            assert f"{NAME}@" in ended(started(evaluate))
            assert '"action":' in ended(started(request, url))
            assert simulator.poll() is None
        finally:
            for process in filter(None, (run, simulator)):
                process.kill()
                process.wait()
