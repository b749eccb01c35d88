"""What a run says about the simulators of its league."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from league.registry.gateways import Gateway
from league.registry.registry import Registry
from tests.support.leagues import tictactoe
from training.runs import simulator_watch
from training.runs.simulator_watch import SimulatorWatch

LEAGUE = tictactoe.LEAGUE
TRAINING = Gateway("ws://127.0.0.1:8001", "secret", LEAGUE, "training")


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    opened = tictactoe.registry(tmp_path / "home")
    yield opened
    opened.close()


def test_changes_are_said_once(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulator_watch, "POLL", 0.0)
    lines: list[str] = []
    watch = SimulatorWatch(registry, LEAGUE, lines.append)
    registry.gateways.announce(replace(TRAINING, url="ws://127.0.0.1:8002", purpose="evaluation"))
    watch.on_step_begin()
    assert lines == []
    address = f"Simulators of league {LEAGUE} connect to the server, or here: ws://127.0.0.1:8001 with the key secret"
    waits = "The run waits for simulators. Its minutes do not pass."
    for simulators, said in (
        (0, [address, waits]),
        (0, []),
        (1, ["1 simulator is connected."]),
        (3, ["3 simulators are connected."]),
        (0, [waits]),
    ):
        registry.gateways.announce(replace(TRAINING, simulators=simulators))
        lines.clear()
        watch.on_step_begin()
        assert lines == said


def test_the_registry_is_not_asked_at_each_step(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulator_watch, "POLL", 3600.0)
    lines: list[str] = []
    watch = SimulatorWatch(registry, LEAGUE, lines.append)
    watch.on_step_begin()
    registry.gateways.announce(TRAINING)
    watch.on_step_begin()
    assert lines == []
