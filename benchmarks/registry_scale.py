"""Load that many replicas and leagues put on a registry in PostgreSQL.

idle              a replica without requests: processor time of PostgreSQL, and connections
watchers          200 replicas and the server on one core: time from a promotion until `--wait` returns
acknowledgement   a replica has followed changes of 1,000 leagues: time to acknowledge them
follower-check    5,000 replicas: time of one look of `--wait`; of a change token; of a heartbeat

The watchers are those of replicas, but load nothing. Leagues and replicas of the last two are rows.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from statistics import median, quantiles
from typing import Annotated, Any

import typer
from sqlalchemy import insert, select

from benchmarks.harness import ROOT, Parts, Quick, Target, chosen
from benchmarks.leagues.served_league import LEAGUE, fill, promote
from benchmarks.registry import server_load
from benchmarks.registry.postgresql_replicas import standalone_replica
from league.errors import NotReady
from league.registry.registry import Registry
from league.registry.storage.database import clock
from league.registry.storage.rows import AliasEvent, LeagueRow, ReadPosition, ServedState
from league.registry.storage.tables import AliasTable, ReplicaTable, VersionTable
from league.settings import Storage
from tests.support.servers import postgresql

SETTLED, MEASURED = 15.0, 60.0
"""Seconds."""
WATCHERS, LEAGUES, REPLICAS = 200, 1000, 5000
PROMOTIONS, ACKNOWLEDGEMENTS, LOOKS = 200, 40, 100
HIDDEN = (8,)
CPU, CONNECTIONS, PROMOTED, ACKNOWLEDGED, LOOKED = 1.0, 1, 0.5, 50.0, 5.0
"""Targets: ms per second, number, s, ms, ms. Before the change counter 5, 2, –, 5,880 and 95."""


class _EnoughLooks(Exception):
    pass


def main(
    parts: Parts = None,
    quick: Quick = False,
    watchers: Annotated[int, typer.Option(help="number of replicas of this part")] = WATCHERS,
    promotions: Annotated[int, typer.Option(help="of the same part")] = PROMOTIONS,
) -> Iterator[Target]:
    """Measure the parts."""
    if quick:
        watchers, promotions = 10, 10
    cases: dict[str, Callable[[Registry, Path], Iterator[Target]]] = {
        "idle": lambda registry, socket: _idle(registry, socket, SETTLED, 5.0 if quick else MEASURED),
        "acknowledgement": lambda registry, _: _acknowledgement(registry, 50 if quick else LEAGUES),
        "follower-check": lambda registry, socket: _follower_check(registry, socket, 50 if quick else REPLICAS),
        "watchers": lambda registry, socket: _watchers(registry, socket, watchers, promotions),
    }
    for name, part in chosen(parts, cases).items():
        if name == "watchers":
            server_load.on_one_core()
        with _registry() as (registry, socket):
            yield from part(registry, socket)


@contextmanager
def _registry() -> Iterator[tuple[Registry, Path]]:
    """A registry with a league of two versions, and the directory of its server's socket."""
    programs = postgresql.programs()
    if programs is None:
        sys.exit("PostgreSQL is not installed")
    with (
        postgresql.server(programs, max_connections=WATCHERS + 50) as socket,
        tempfile.TemporaryDirectory() as scratch,
    ):
        storage = Storage.at(Path(scratch) / "home")
        storage.home.mkdir(parents=True)
        registry = fill(Registry.open(replace(storage, database_url=postgresql.create(socket, "scale"))), 2, HIDDEN)
        yield registry, socket
        registry.close()


def _idle(registry: Registry, socket: Path, settled: float, seconds: float) -> Iterator[Target]:
    server = server_load.postmaster(socket)
    registry.close()
    with standalone_replica(registry.storage, "idle"):
        time.sleep(settled)
        connections = server_load.connections(socket, postgresql.USER)
        busy = _busy(server, seconds)
    time.sleep(settled)
    alone = _busy(server, seconds)
    note = f"{busy:.2f} with the replica, {alone:.2f} without"
    yield Target("idle replica, PostgreSQL's time", round(busy - alone, 2), "ms/s", at_most=CPU, note=note)
    yield Target("idle replica, connections", connections, at_most=CONNECTIONS)


def _busy(server: int, seconds: float) -> float:
    """Processor time of a server in ms per second."""
    before, at = server_load.cpu_seconds(server), time.monotonic()
    time.sleep(seconds)
    return 1000 * (server_load.cpu_seconds(server) - before) / (time.monotonic() - at)


def _acknowledgement(registry: Registry, leagues: int) -> Iterator[Target]:
    names = _copies_of_the_league(registry, leagues)
    newest = max(target.event for target in registry.aliases.all().values())
    position = ReadPosition(registry.changes.counts().to_acknowledge, newest, 0)
    registry.replicas.register("replica", {})
    followed = [
        _milliseconds(lambda: registry.replicas.acknowledge("replica", position, {}, ()))
        for _ in range(ACKNOWLEDGEMENTS)
    ]
    loading = {name: ServedState(1, "0" * 64, None, {"champion": 1}, newest) for name in names}
    differing = [
        _milliseconds(lambda: registry.replicas.acknowledge("replica", position, loading))
        for _ in range(ACKNOWLEDGEMENTS)
    ]
    note = f"{leagues:,} leagues; while all of them load a version {median(differing):.1f} ms"
    yield Target(
        "acknowledgement of followed leagues", round(median(followed), 1), "ms", at_most=ACKNOWLEDGED, note=note
    )


def _follower_check(registry: Registry, socket: Path, replicas: int) -> Iterator[Target]:
    event = promote(registry, 2)
    _add_replicas(registry, replicas, event.id)
    registry.replicas.register("late", {})
    server = server_load.postmaster(socket)
    before = server_load.cpu_seconds(server), time.process_time()
    looks = _time_between_looks(registry, event)
    busy = [
        1000 * (end - begin) / LOOKS
        for end, begin in zip((server_load.cpu_seconds(server), time.process_time()), before, strict=True)
    ]
    tokens = [_milliseconds(lambda: registry.changes.token(LEAGUE)) for _ in range(LOOKS)]
    heartbeats = [_milliseconds(lambda: _heartbeat(registry)) for _ in range(LOOKS)]
    note = f"{replicas:,} replicas; processor time {busy[0]:.2f} ms of PostgreSQL, {busy[1]:.2f} ms of the client"
    yield Target("one look of --wait", round(median(looks), 2), "ms", at_most=LOOKED, note=note)
    yield Target("change token, heartbeat", (round(median(tokens), 1), round(median(heartbeats), 1)), "ms")


def _time_between_looks(registry: Registry, event: Any) -> list[float]:
    times: list[float] = []

    def note(_: float) -> None:
        times.append(time.perf_counter())
        if len(times) > LOOKS:
            raise _EnoughLooks

    try:
        registry.changes.wait_for_alias(event, 600, note)
    except _EnoughLooks:
        return [1000 * (after - before) for before, after in pairwise(times)]
    raise AssertionError("a replica that has read nothing was counted as one that follows")


def _heartbeat(registry: Registry) -> None:
    registry.replicas.register("late", {})
    registry.replicas.silent()


def _watchers(registry: Registry, socket: Path, number: int, promotions: int) -> Iterator[Target]:
    storage = registry.storage
    command = [sys.executable, "-m", "benchmarks.registry.watchers", str(number), str(storage.home)]
    with subprocess.Popen(
        [*command, storage.database_url], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdin is not None
        if not process.stdout.readline():
            sys.exit("the watchers did not start")
        server = server_load.postmaster(socket)
        before = server_load.cpu_seconds(server) + server_load.process_seconds(process.pid)
        seconds = [_promote(registry, 1 + (i + 1) % 2, number) for i in range(promotions)]
        busy = server_load.cpu_seconds(server) + server_load.process_seconds(process.pid) - before
        process.stdin.close()
    p99 = quantiles(seconds, n=100, method="inclusive")[98]
    note = f"median {median(seconds):.3f} s, processor time {busy / promotions:.3f} s"
    yield Target(f"promotion to {number} watchers, p99", round(p99, 2), "s", at_most=PROMOTED, note=note)


def _promote(registry: Registry, version: int, number: int) -> float:
    began = time.monotonic()
    try:
        confirmed = registry.changes.wait_for_alias(promote(registry, version), 60)
    except NotReady as error:
        sys.exit(f"a promotion was not followed: {error}")
    assert len(confirmed) == number
    return time.monotonic() - began


def _copies_of_the_league(registry: Registry, number: int) -> list[str]:
    """Insert leagues with the rows of LEAGUE; returns their names."""
    names = [f"league-{i:04}" for i in range(number)]
    with registry.database.write() as session:
        for table in (LeagueRow, VersionTable):
            name = "slug" if table is LeagueRow else "league"
            rows = session.execute(select(table.__table__).filter_by(**{name: LEAGUE})).mappings()
            session.execute(insert(table), [dict(row) | {name: copy} for row in rows for copy in names])
        moment = clock(session)
        event = {"alias": "champion", "kind": "set", "version": 1, "actor": "benchmark", "reason": "many", "at": moment}
        session.execute(insert(AliasEvent), [event | {"league": name} for name in names])
        events = session.execute(select(AliasEvent.id, AliasEvent.league))
        aliases = [{"league": name, "name": "champion", "version": 1, "event": id_} for id_, name in events]
        session.execute(insert(AliasTable), [row for row in aliases if row["league"] != LEAGUE])
    return names


def _add_replicas(registry: Registry, number: int, event: int) -> None:
    with registry.database.write() as session:
        row = {"process": {"machine": "elsewhere"}, "seen_at": clock(session), "changes": event, "event": event}
        session.execute(insert(ReplicaTable), [row | {"replica": f"replica-{i:05}"} for i in range(number)])


def _milliseconds(function: Callable[[], object]) -> float:
    began = time.perf_counter()
    function()
    return 1000 * (time.perf_counter() - began)
