"""The process-wide players of matches: their environments are closed."""

from collections import OrderedDict
from pathlib import Path
from typing import Any

import pytest

from evaluation.matches import worker as worker_module
from evaluation.matches.tournament import play_schedule
from evaluation.matches.worker import MatchWorker, match_worker
from evaluation.schedules.builders import round_robin
from league.config.league import LeagueConfig
from league.environments import building
from league.environments.building import interface
from league.errors import GameCrashed
from league.registry.registry import Registry
from league.results.records import Schedule
from league.settings import Storage
from tests.support.environments import engines
from tests.support.environments.engines import RUNNING

PLAYERS = ("script:random", "script:first")


def settings(league: str = "engines", **kwargs: Any) -> LeagueConfig:
    environment = {"entry_point": f"{engines.__name__}:engine", "kwargs": kwargs}
    return LeagueConfig.from_mapping({"league": league, "environment": environment, "play": {"num_envs": 3}})


@pytest.fixture
def registry(tmp_path: Path) -> Registry:
    return Registry.open(Storage.at(tmp_path))


def schedule_of(registry: Registry, config: LeagueConfig, blocks: int = 12) -> Schedule:
    registry.leagues.register(config, interface(config))
    row = registry.leagues.get(config.league)
    return round_robin(row.config, row.interface, PLAYERS, blocks)


def test_environments_are_closed_at_the_end_of_a_schedule(registry: Registry, caplog: pytest.LogCaptureFixture) -> None:
    """Also if it ends early. What `close` raises is logged once for all copies."""
    building._log_once.cache_clear()
    schedule = schedule_of(registry, settings(closes="raises"))
    running: list[int] = []

    def is_enough(matches: Any) -> bool:
        running.append(len(RUNNING))
        return len(matches) > 3

    assert len(play_schedule(schedule, registry=registry, enough=is_enough)) < schedule.length
    assert max(running) == 3
    assert RUNNING == []
    assert [record.message.partition(" (")[0] for record in caplog.records] == [
        "The environment's close raised an exception"
    ]


@pytest.mark.parametrize("closes", ["well", "raises", "exits"])
def test_environments_are_closed_after_a_crash(registry: Registry, closes: str) -> None:
    config = settings(closes=closes)
    schedule = schedule_of(registry, config)
    worker = MatchWorker(config, registry)

    def fail(*_: Any) -> None:
        raise ValueError("the board is gone")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(engines.Engine, "step", fail)
        with pytest.raises(GameCrashed, match="the board is gone"):
            worker.play(schedule, range(2))
    assert RUNNING == []
    assert len(worker.play(schedule, range(2))) == 2
    worker.close_environment()
    assert RUNNING == []


def test_environments_are_closed_with_their_worker(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker_module, "MOST_WORKERS", 1)
    monkeypatch.setattr(worker_module, "_workers", OrderedDict())
    configs = [settings("first"), settings("second")]
    for config in configs:
        schedule = schedule_of(registry, config)
        match_worker(registry.storage, config.model_dump_json(by_alias=True)).play(schedule, range(2))
    assert len(RUNNING) == 3, "the first one was evicted"
    worker_module._workers.popitem()[1].close()
    assert RUNNING == []


@pytest.mark.usefixtures("ray_session")
def test_environments_of_tasks_are_closed(registry: Registry, tmp_path: Path) -> None:
    """Ray ends their processes without a word. A schedule that ends early interrupts its tasks."""
    log = tmp_path / "log"
    schedule = schedule_of(registry, settings(log=str(log)), blocks=200)
    matches = play_schedule(schedule, registry=registry, workers=1, enough=lambda matches: len(matches) > 10)
    assert len(matches) < schedule.length
    events = log.read_text().split()
    assert len(events) > 2 * 3
    assert events.count("ends") == events.count("starts")
