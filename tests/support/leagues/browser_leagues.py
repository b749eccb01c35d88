"""Leagues for the browser tests: tic-tac-toe after a nightly run, connect four to play, and one without results."""

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import httpx

from evaluation.matches.tournament import evaluate
from evaluation.service.snapshots import refresh
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.refs import CheckpointRef
from league.registry.registry import Registry
from league.registry.storage.rows import Portion, RunPoint, StrengthRow, VerdictRow
from league.search.policies import publish_search
from tests.support.leagues import tictactoe
from tests.support.leagues.reported_league import HOSTILE, league_after_nightly
from tests.support.leagues.tictactoe import LEAGUE
from tests.support.policies.graphs import masked_mlp
from tests.support.waiting import until

CONFIGS = Path(__file__).parents[3] / "policy_league/configs"
CONNECT_FOUR, EMPTY = "connect_four", "two_step_game"
TEAM, LONG = "team", "n" * 60 + "_" + "m" * 39
"""The two-step game, whose agents are a team, and tic-tac-toe with the longest name and the longest reason."""
NAMED, HIDDEN, VIEWS, SEARCHED = "named", "hidden", "views", "searched"
"""Tic-tac-toe with names of actions, with pictures that show hidden information, with one view per agent, and with a
version that searches."""
SIMULATIONS = 40
DIRECTIONS = ["up-left", "left", "down-left", "up", "centre", "down", "up-right", "right", "down-right"]
RUN = "ppo-17"
KEYS = {"everything": ["act", "read", "evaluate", "promote"], "evaluator": ["evaluate", "read"], "reader": ["read"]}


@contextmanager
def leagues_of_every_page(home: Path) -> Iterator[Registry]:
    """Data for each page, including hostile text."""
    with league_after_nightly(home) as registry:
        for name in (CONNECT_FOUR, EMPTY):
            config = LeagueConfig.load(CONFIGS / f"{name}.yaml")
            registry.leagues.register(config, interface(config))
        hidden, views = (
            {"entry_point": f"tests.support.environments.declaring:{name}"} for name in ("Revealing", "Declaring")
        )
        for config in (
            tictactoe.config(league=NAMED, play={"action_names": DIRECTIONS}),
            tictactoe.config(league=HIDDEN, environment=hidden),
            tictactoe.config(league=VIEWS, environment=views),
            tictactoe.config(league=LONG),
            tictactoe.config(league=SEARCHED),
            LeagueConfig.load(CONFIGS / f"{EMPTY}.yaml").model_copy(update={"league": TEAM}),
        ):
            registry.leagues.register(config, interface(config))
        change_game(registry)
        tictactoe.publish(registry, tictactoe.graph(), LONG)
        registry.aliases.set(LONG, "champion", 1, expected=None, actor="a" * 100, reason="why " * 500)
        evaluate(LONG, [f"{LONG}@1", "script:random"], registry=registry, blocks=1)
        value = masked_mlp((3, 3, 2), 9, has_value=True)
        base, row = (
            tictactoe.publish(registry, masked_mlp((3, 3, 2), 9), SEARCHED, value=value),
            registry.leagues.get(SEARCHED),
        )
        searching = publish_search(registry, base, row.config.environment, row.interface, "puct", SIMULATIONS)
        evaluate(SEARCHED, [base.ref, searching.ref, "script:random"], registry=registry, blocks=1)
        evaluate(TEAM, ["script:random", "script:first"], registry=registry, blocks=2)
        registry.traffic.set(LEAGUE, canary=Portion(1, 0.05), shadow=Portion(2, 1.0), actor=HOSTILE, reason=HOSTILE)
        registry.versions.set_note(CheckpointRef(LEAGUE, 2), HOSTILE, actor=HOSTILE)
        registry.runs.begin(
            LEAGUE, RUN, algorithm="ppo", settings={"note": HOSTILE, "minutes": 10}, seed=17, target=40_000
        )
        for number in range(20):
            record(registry, 1000 * (number + 1))
        registry.strength.record(list(map(strength, (1, 2, 3))))
        nights(registry)
        compute(registry)
        yield registry


def change_game(registry: Registry) -> None:
    """Play matches of a league, and change its game afterwards."""
    row = registry.leagues.get(NAMED)
    before = row.config.model_copy(update={"play": row.config.play.model_copy(update={"opening_plies": 4})})
    registry.leagues.register(before, row.interface)
    evaluate(NAMED, ["script:random", "script:one_ply"], registry=registry, blocks=2)
    registry.leagues.register(row.config, row.interface)


def strength(number: int) -> StrengthRow:
    """The score of a version of the run."""
    score = 0.4 + number / 10
    return StrengthRow(
        league=LEAGUE,
        version=number,
        opponent="script:random",
        run=RUN,
        steps=6000 * number,
        games=200,
        score=score,
        low=score - 0.1,
        high=score + 0.1,
        at=datetime.now(UTC),
    )


def nights(registry: Registry) -> None:
    """Two nights of training with the champions 1 and 2."""
    for number in (1, 2):
        night, ref = registry.training_nights.open(LEAGUE), f"{LEAGUE}@{number}"
        score = {"ref": f"{LEAGUE}@3", "games": 64, "score": 0.8 - number / 10, "low": 0.5, "high": 0.9}
        score["gain"] = {"mean": 0.6 - number / 5, "low": 0.0, "high": 0.8}
        for step, result in {
            "train": {"run": RUN, "versions": [ref]},
            "gate": {"champion_before": None, "champion": ref, "verdicts": []},
            "exploiter": {"target": ref, "versions": [f"{LEAGUE}@3"], "error": HOSTILE},
            "measure": {"exploitability": {"ref": ref, "bound": 0.5, "exploiters": [score]}},
        }.items():
            registry.training_nights.record(night.id, step, result)
        registry.training_nights.close(night.id)


def compute(registry: Registry) -> None:
    """Compute the snapshots that the evaluation service would compute."""
    for league in registry.leagues.names():
        refresh(registry, league)


def record(registry: Registry, steps: int) -> None:
    """Record progress of the run."""
    curves = {"player/return": steps / 40_000, "player/entropy": 2 - steps / 40_000, "time/sampling": 1.5}
    curves |= {f"opponents/{LEAGUE}@1/share": 0.3, f"opponents/{LEAGUE}@1/score": 0.4 + steps / 100_000}
    registry.runs.record(LEAGUE, RUN, RunPoint(LEAGUE, RUN, steps, curves, datetime.now(UTC)), seconds=0.0225 * steps)


def verdict_between_versions(registry: Registry) -> VerdictRow:
    """A verdict that promoted a version over another version."""
    closed = [verdict for verdict in registry.verdicts.all(LEAGUE) if verdict.outcome == "promote"]
    return next(verdict for verdict in closed if not verdict.champion.startswith("script:"))


def answer(method: str, url: str, body: Any = None) -> Any:
    """The response of the evaluation service; retries while it, or the server on a busy machine, is not ready."""
    replies: list[httpx.Response] = []

    def is_ready() -> bool:
        replies.append(httpx.request(method, url, json=body, timeout=60))
        return replies[-1].status_code not in (503, 504)

    until(is_ready, seconds=240)
    return replies[-1].raise_for_status().json()
