"""Games in other languages train and play matches: they are the games of the same rules in Python."""

import os
import shutil
import subprocess
from contextlib import closing
from pathlib import Path

import pytest

from evaluation.matches.game_loop import play_matches
from evaluation.schedules.builders import round_robin
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.environments.implementation import stock_stepping
from league.policies.scripted import script
from tests.support import simulators
from tests.support.servers.streaming import listening
from tests.support.simulators import external, stepping

pytestmark = pytest.mark.slow  # installs packages

TYPESCRIPT = Path(__file__).parents[2] / "clients/typescript"
STOCK = LeagueConfig.from_mapping(
    {
        "league": "connect_four",
        "environment": {"entry_point": "pettingzoo.classic.connect_four_v3"},
        "play": {"opening_plies": 2},
    }
)
CONTESTANTS = ["script:random", "script:one_ply", "script:minimax_2"]
BLOCKS = 10


def test_connect_four_in_typescript_is_that_of_pettingzoo(tmp_path: Path) -> None:
    if shutil.which("npm") is None:
        (pytest.fail if os.environ.get("CI") else pytest.skip)("npm is not installed")
    if not (TYPESCRIPT / "node_modules").is_dir():
        subprocess.run(["npm", "ci", "--no-audit", "--no-fund"], cwd=TYPESCRIPT, check=True)
    subprocess.run(["npm", "run", "build"], cwd=TYPESCRIPT, check=True, capture_output=True)
    config = external(STOCK)
    section = config.environment.external
    assert section is not None
    section = section.model_copy(update={"simulator": "connect-four-ts", "version": "1"})
    registry = simulators.registry(tmp_path, external(STOCK, environment={"external": section.model_dump(mode="json")}))
    game = interface(STOCK)
    spaces = game.of_policy("shared")
    roster = {
        ref: dict.fromkeys(
            game.agents, ("shared", script(ref.removeprefix("script:"), spaces.observation, spaces.action))
        )
        for ref in CONTESTANTS
    }
    schedule = round_robin(STOCK, game, CONTESTANTS, BLOCKS)
    positions = range(schedule.length)
    expected = play_matches(schedule, positions, stock_stepping(STOCK.environment, 16), game, roster)
    _, token = registry.keys.create("game", ["simulate"])
    program = ["node", "--experimental-websocket", "dist/examples/connect_four.js"]
    with listening(registry.storage) as server, closing(stepping(registry, 16)) as environment:
        arguments = [server.url, simulators.LEAGUE, str(2 * schedule.length)]
        with subprocess.Popen(
            [*program, *arguments], cwd=TYPESCRIPT, env=os.environ | {"LEAGUE_API_KEY": token}
        ) as process:
            assert play_matches(schedule, positions, environment, game, roster) == expected
            assert process.wait(60) == 0
