"""Take the screenshots of docs/pages.md: every page of a league with real results.

python -m scripts.screenshots [DIRECTORY]
"""

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from random import Random
from shutil import which
from tempfile import TemporaryDirectory

from PIL import Image
from playwright.sync_api import Browser, expect, sync_playwright

from evaluation.gating.nightly import nightly
from evaluation.matches.tournament import evaluate
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.refs import CheckpointRef
from league.registry.registry import Registry
from league.registry.storage.rows import Portion
from serve_app.runtime.launch import running
from tests.support.clients.browsers import ARGUMENTS, expect_finished
from tests.support.leagues import tictactoe
from tests.support.leagues.browser_leagues import (
    CONFIGS,
    CONNECT_FOUR,
    answer,
    compute,
    verdict_between_versions,
)
from tests.support.leagues.tictactoe import LEAGUE
from training.runs.train import train

IMAGES = Path(__file__).parents[1] / "docs" / "images"
CONFIG = tictactoe.config(play={"opening_plies": 2, "num_envs": 8})
SEED = 4
COLORS = 160
SIZE = {"width": 1180, "height": 780}
TRAINED = "tictactoe_ppo"
L = f"/leagues/{LEAGUE}"
PLAYED = f"/leagues/{CONNECT_FOUR}/play#opponent=script:one_ply&agent=player_0&seed=3&actions=3,2,4,2"


@dataclass(frozen=True, slots=True)
class Picture:
    """A screenshot of a page, taken as soon as the page contains `text`."""

    name: str
    path: str
    text: str
    is_dark: bool = False


PICTURES = (
    Picture("leaderboard", L, "95 % interval"),
    Picture("payoff", f"{L}/payoff", "always wins"),
    Picture("versions", f"{L}/versions", "became champion"),
    Picture("verdict-dark", f"{L}/verdicts/{{verdict}}", "Blocks by result", is_dark=True),
    Picture("game", f"{L}/matches/{{verdict}}/0/0#5", "Step 5"),
    Picture("play", PLAYED, "Your turn"),
    Picture("run", f"/leagues/{TRAINED}/runs/{{run}}", "entropy"),
)


@contextmanager
def leagues(home: Path) -> Iterator[Registry]:
    """Tic-tac-toe with fourteen versions and a nightly run for each, a trained league, and connect four."""
    registry = tictactoe.registry(home, play=CONFIG.play.model_dump())
    chance = Random(SEED)
    for wins, blocks, centre in sorted(product((False, True), repeat=3)):
        best = list(tictactoe.CENTRE_FIRST if centre else tictactoe.EDGES_FIRST)
        for order in (chance.sample(best, 9), best) if wins or blocks else (best,):
            tictactoe.publish(registry, tictactoe.graph(wins=wins, blocks=blocks, order=tuple(order)))
            nightly(CONFIG, registry=registry)
    evaluate(LEAGUE, registry=registry, blocks=8)
    config = LeagueConfig.load(CONFIGS / f"{CONNECT_FOUR}.yaml")
    registry.leagues.register(config, interface(config))
    registry.traffic.set(LEAGUE, canary=Portion(2, 0.05), shadow=None, actor="release-bot", reason="trial")
    registry.versions.set_note(CheckpointRef(LEAGUE, 11), "takes the centre first", actor="ada")
    _train(registry)
    compute(registry)
    yield registry
    registry.close()


def _train(registry: Registry) -> None:
    """Train by self-play for up to two minutes, in a separate league."""
    config = LeagueConfig.load(CONFIGS / "tictactoe.yaml").model_copy(update={"league": TRAINED})
    train(config.with_training(runners=1, checkpoint_every=None, minutes=2), registry=registry)


def take(browser: Browser, url: str, picture: Picture, names: dict[str, str], directory: Path) -> None:
    """Take one screenshot, with a reduced palette."""
    page = browser.new_page(viewport=SIZE, color_scheme="dark" if picture.is_dark else "light", reduced_motion="reduce")
    page.goto(url + picture.path.format(**names))
    expect(page.locator("main")).to_contain_text(re.compile(picture.text))
    expect_finished(page)
    path = directory / f"{picture.name}.png"
    page.screenshot(path=path)
    page.close()
    with Image.open(path) as image:
        image.convert("RGB").quantize(COLORS, dither=Image.Dither.NONE).save(path, optimize=True)
    print(f"{path} {path.stat().st_size // 1024} KiB")


def main(directory: Path) -> None:
    """Take all screenshots."""
    with TemporaryDirectory() as home, leagues(Path(home)) as registry, running(registry.storage, replicas=1) as url:
        for league in (LEAGUE, CONNECT_FOUR):
            answer("GET", f"{url}/v1/leagues/{league}/playable")
        names = {"verdict": verdict_between_versions(registry).id, "run": registry.runs.newest(TRAINED)[0].id}
        with sync_playwright() as playwright:
            path = which("chromium") or playwright.chromium.executable_path
            expect.set_options(timeout=90_000)
            browser = playwright.chromium.launch(executable_path=path, args=ARGUMENTS)
            for picture in PICTURES:
                take(browser, url, picture, names, directory)
            browser.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else IMAGES)
