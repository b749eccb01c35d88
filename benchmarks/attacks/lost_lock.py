"""Nightly runs whose lock is lost because PostgreSQL ends their connection, while a second run waits for the lock."""

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from sqlalchemy import text

from benchmarks.harness import ROOT, Target
from league.registry.registry import Registry
from league.settings import Storage
from tests.support.leagues import tictactoe
from tests.support.leagues.judged_league import CONFIG
from tests.support.servers import postgresql
from tests.support.waiting import until

VERSIONS = ({}, {"blocks": True}, {"wins": True}, {"wins": True, "blocks": True})
DEADLINE = 120.0
RUN = """
import sys
from pathlib import Path
from league.errors import AlreadyRunning
from league.registry.registry import Registry
from league.settings import Storage
from evaluation.gating.nightly import nightly
from tests.support.leagues.judged_league import CONFIG

registry = Registry.open(Storage(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3])))
print("ready", flush=True)
sys.stdin.readline()
while True:
    try:
        nightly(CONFIG, registry=registry)
        break
    except AlreadyRunning:
        pass
"""
HOLDERS = """
SELECT pid FROM pg_locks WHERE locktype = 'advisory' AND granted
AND database = (SELECT oid FROM pg_database WHERE datname = current_database())
"""
TABLES = ("matches", "verdicts", "alias_events", "nightly_runs")


def lost_locks(runs: int) -> Iterator[Target]:
    """How many first runs changed something after they had lost their lock, and how many second runs ended unlike an
    undisturbed one.
    """
    programs = postgresql.programs()
    if programs is None:
        sys.exit("PostgreSQL is not installed")
    at_work = unequal = 0
    with postgresql.server(programs) as socket, tempfile.TemporaryDirectory() as scratch:
        expected = _undisturbed(_league(Path(scratch) / "quiet", postgresql.create(socket, "quiet")))
        for number in range(runs):
            registry = _league(Path(scratch) / str(number), postgresql.create(socket, f"run_{number}"))
            changes, state = _disturbed(registry, delay=0.02 * (number % 10))
            at_work += changes > 0
            unequal += state != expected
    yield Target("lost locks: runs that changed something afterwards", at_work, at_most=0, note=f"of {runs}")
    yield Target("lost locks: different results of the second run", unequal, at_most=0)


def _league(home: Path, database_url: str) -> Registry:
    registry = Registry.open(replace(Storage.at(home), database_url=database_url))
    registry.leagues.register(CONFIG, tictactoe.interface(CONFIG))
    for skill in VERSIONS:
        tictactoe.publish(registry, tictactoe.graph(**skill))
    return registry


def _undisturbed(registry: Registry) -> list[tuple[object, ...]]:
    with ExitStack() as stack:
        run = _run(stack, registry)
        _begin(run)
        assert run.wait(DEADLINE) == 0
    return _state(registry)


def _disturbed(registry: Registry, delay: float) -> tuple[int, list[tuple[object, ...]]]:
    """The number of rows that the first run added after it had lost its lock, and the final state."""
    with ExitStack() as stack:
        # Both have imported their modules before the first begins: it would end while the second imports them.
        first, second = _run(stack, registry), _run(stack, registry)
        _begin(first)
        until(lambda: _counts(registry)["matches"] > 0, DEADLINE)
        _begin(second)
        time.sleep(delay)
        with registry.database.write() as session:
            session.execute(text(f"SELECT pg_terminate_backend(pid) FROM ({HOLDERS}) AS holders"))
        until(lambda: _holders(registry) or second.poll() is not None, DEADLINE)
        os.kill(second.pid, signal.SIGSTOP)
        before = _counts(registry)
        failed = first.wait(DEADLINE) != 0
        added = sum(_counts(registry).values()) - sum(before.values())
        os.kill(second.pid, signal.SIGCONT)
        assert second.wait(DEADLINE) == 0
    return added + (not failed), _state(registry)


def _run(stack: ExitStack, registry: Registry) -> subprocess.Popen[str]:
    storage = registry.storage
    command = [sys.executable, "-c", RUN, str(storage.home), storage.database_url, str(storage.artifacts)]
    quiet = {"stderr": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stdin": subprocess.PIPE}
    run = stack.enter_context(subprocess.Popen(command, cwd=ROOT, text=True, **quiet))
    stack.callback(run.kill)
    assert run.stdout is not None
    run.stdout.readline()
    return run


def _begin(run: subprocess.Popen[str]) -> None:
    assert run.stdin is not None
    run.stdin.write("\n")
    run.stdin.flush()


def _state(registry: Registry) -> list[tuple[object, ...]]:
    """Verdicts and promotions."""
    verdicts = [(row.candidate, row.champion, row.outcome) for row in registry.verdicts.all(tictactoe.LEAGUE)]
    return [*verdicts, *((event.version, event.previous) for event in registry.aliases.history(tictactoe.LEAGUE))]


def _counts(registry: Registry) -> dict[str, int]:
    with registry.database.read() as session:
        return {table: session.execute(text(f"SELECT count(*) FROM {table}")).scalar_one() for table in TABLES}


def _holders(registry: Registry) -> list[int]:
    with registry.database.read() as session:
        return list(session.execute(text(HOLDERS)).scalars())
