"""Leagues for the pages: tic-tac-toe after a night, connect four to be played, and one that has nothing yet."""

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import httpx

from evaluation.snapshots import refresh
from league.config import LeagueConfig
from league.environments.building import interface
from league.refs import CheckpointRef
from league.registry.registry import Registry
from league.registry.rows import Portion, RunPoint, VerdictRow
from tests.evaluation.examples import LEAGUE
from tests.evaluation.pages.leagues import HOSTILE, of_a_night
from tests.evaluation.waiting import until

CONFIGS = Path(__file__).parents[2] / "configs"
CONNECT_FOUR, EMPTY = "connect_four", "two_step_game"
RUN = "ppo-17"
KEYS = {"everything": ["act", "read", "evaluate", "promote"], "evaluator": ["evaluate", "read"], "reader": ["read"]}


@contextmanager
def of_every_page(home: Path) -> Iterator[Registry]:
    """Something for each page to show, hostile words among it."""
    with of_a_night(home) as registry:
        for name in (CONNECT_FOUR, EMPTY):
            config = LeagueConfig.load(CONFIGS / f"{name}.yaml")
            registry.register(config, interface(config))
        registry.set_traffic(LEAGUE, canary=Portion(1, 0.05), shadow=Portion(2, 1.0), actor=HOSTILE, reason=HOSTILE)
        registry.note(CheckpointRef(LEAGUE, 2), HOSTILE, actor=HOSTILE)
        registry.begin_run(
            LEAGUE, RUN, algorithm="ppo", settings={"note": HOSTILE, "minutes": 10}, seed=17, target=40_000
        )
        for number in range(20):
            record(registry, 1000 * (number + 1))
        compute(registry)
        yield registry


def compute(registry: Registry) -> None:
    """What a studio does before long: who stands where."""
    for row in registry.leagues():
        refresh(registry, row.slug)


def record(registry: Registry, steps: int) -> None:
    """The run gets further."""
    curves = {"player/return": steps / 40_000, "player/entropy": 2 - steps / 40_000, "time/sampling": 1.5}
    registry.record_point(LEAGUE, RUN, RunPoint(steps, curves, datetime.now(UTC)), seconds=0.0225 * steps)


def verdict_between_versions(registry: Registry) -> VerdictRow:
    """A promotion of a version that beat another."""
    closed = [each for each in registry.verdicts(LEAGUE) if each.outcome == "promote"]
    return next(each for each in closed if not each.champion.startswith("script:"))


def answer(method: str, url: str, body: Any = None) -> Any:
    """What the studio says, which has it done before long."""
    replies: list[httpx.Response] = []

    def is_done() -> bool:
        replies.append(httpx.request(method, url, json=body, timeout=60))
        return replies[-1].status_code != 503

    until(is_done, seconds=120)
    return replies[-1].raise_for_status().json()
