"""Gateways are found while they are announced."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from datetime import timedelta

import pytest

from league.registry import gateways
from league.registry.processes import has_ended, host_name, is_local, this_process
from league.registry.registry import Registry
from league.registry.storage.rows import Gateway
from tests.support.leagues.registries import LEAGUE

PROGRAM = "from league.registry.processes import this_process; print(this_process(), flush=True); input()"


@pytest.fixture
def other() -> Iterator[tuple["subprocess.Popen[str]", str]]:
    """Another process, and its identity."""
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        yield process, process.stdout.readline().strip()
        process.kill()


def test_a_process_that_runs_has_not_ended(other: tuple["subprocess.Popen[str]", str]) -> None:
    process, identity = other
    assert is_local(identity)
    assert not has_ended(identity)
    assert not has_ended(this_process())
    process.send_signal(signal.SIGSTOP)
    assert not has_ended(identity), "a stuck process may continue"


@pytest.mark.parametrize("reaped", [True, False])
def test_a_killed_process_has_ended(other: tuple["subprocess.Popen[str]", str], reaped: bool) -> None:
    process, identity = other
    process.kill()
    os.waitid(os.P_PID, process.pid, os.WEXITED | (0 if reaped else os.WNOWAIT))
    assert has_ended(identity)


def test_another_process_with_the_same_id() -> None:
    machine, pid, start = this_process().split(":")
    assert has_ended(f"{machine}:{pid}:{int(start) - 1}")


def test_nothing_is_known_of_processes_on_other_machines() -> None:
    _, pid, start = this_process().split(":")
    elsewhere = f"trainer-7/another-start/1:{pid}:{int(start) - 1}"
    assert not is_local(elsewhere)
    assert not has_ended(elsewhere)
    assert host_name(elsewhere) == "trainer-7"


TRAINING = Gateway("http://127.0.0.1:4001", "a", LEAGUE, "training", simulators=2)


EVALUATION = Gateway("http://127.0.0.1:4002", "b", LEAGUE, "evaluation", simulators=2, waiting=7)


def test_gateways_are_found_until_they_close(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    for gateway in (TRAINING, EVALUATION):
        registry.gateways.announce(gateway)
    assert registry.gateways.open(LEAGUE) == [EVALUATION, TRAINING], "an evaluation comes first"
    lonely = replace(TRAINING, simulators=0)
    registry.gateways.announce(lonely)
    assert registry.gateways.open(LEAGUE) == [lonely, EVALUATION], "those with fewer simulators come first"
    assert registry.gateways.open("another") == []
    registry.gateways.close(EVALUATION)
    assert registry.gateways.open(LEAGUE) == [lonely]
    monkeypatch.setattr(gateways, "SILENCE", timedelta(0))
    assert registry.gateways.open(LEAGUE) == [], "its process has died"
