"""Does a tournament whose processes are killed repeatedly have the same result as an undisturbed one?

A Ray cluster on this machine: two nodes with a worker each, and a head without one. A driver in a subprocess plays a
round robin of tic-tac-toe. Repeatedly one of the three is killed at random by SIGKILL: the driver, which is restarted,
the process of a worker during a chunk, or a complete node, which is replaced. After the last kill the tournament runs
undisturbed for a short time and is stopped.

Each start of a chunk is recorded by its worker. Counted are: matches of the ledger that differ from those of an
undisturbed process (lost, duplicated, different); chunks that were started but not in the ledger when a driver was
killed, compared with one per worker; and repeated starts of chunks, compared with those and one for each killed worker
and node. A chunk is delayed for a moment, as tic-tac-toe is quick: otherwise few kills would interrupt one.
"""

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import ray
from ray.cluster_utils import Cluster

from benchmarks.harness import Target
from evaluation.matches import tournament
from evaluation.matches.worker import match_worker
from evaluation.schedules.builders import round_robin
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.policies.loading import baselines
from league.registry.registry import Registry
from league.results.ledger import Ledger
from league.results.records import Match, Schedule
from league.settings import Storage

LEAGUE = "tictactoe"
NODES = 2
HOLD = 0.15
"""Seconds that a worker holds a chunk in addition to playing it."""
DEADLINE = 90.0
"""Seconds without progress after which a tournament has failed."""
KINDS = ("driver", "worker", "node")


def run(quick: bool) -> Iterator[Target]:
    """Kill at random, and compare what was played with an undisturbed tournament."""
    with tempfile.TemporaryDirectory() as scratch:
        registry, schedule = _open(Path(scratch))
        experiment = _Experiment(Path(scratch), random.Random(0), lambda: len(Ledger(registry).positions(schedule.id)))
        try:
            for _ in range(10 if quick else 100):
                experiment.kill_one()
            experiment.end()
        finally:
            experiment.close()
        yield from _results(registry, schedule, experiment)
        registry.close()


def _open(scratch: Path) -> tuple[Registry, Schedule]:
    config = LeagueConfig.from_mapping(
        {
            "league": LEAGUE,
            "environment": {"entry_point": "pettingzoo.classic.tictactoe_v3"},
            "play": {"opening_plies": 1, "num_envs": 4},
        }
    )
    registry = Registry.open(Storage.at(scratch / "home"))
    registry.leagues.register(config, interface(config))
    contestants = [*baselines(config, interface(config)), "script:first"]
    schedule = round_robin(config, interface(config), contestants, blocks=20_000)
    return registry, Ledger(registry).open(schedule)


@dataclass
class _Experiment:
    """The cluster and the driver, and the kills."""

    scratch: Path
    chance: random.Random
    appended: Callable[[], int]
    open_at_driver_kill: list[int] = field(default_factory=list)
    killed: Counter[str] = field(default_factory=Counter)
    cluster: Cluster = field(init=False)
    nodes: list[Any] = field(init=False)
    driver: subprocess.Popen = field(init=False)

    def __post_init__(self) -> None:
        # Beside others on two busy cores, a node may take longer to start than Ray's 30 s.
        os.environ["RAY_raylet_start_wait_time_s"] = str(int(DEADLINE))  # noqa: SIM112
        self.cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
        self.nodes = [self.cluster.add_node(num_cpus=1) for _ in range(NODES)]
        self.driver = self._start()

    def kill_one(self) -> None:
        """Wait until a chunk has started, a little longer, and kill something."""
        begun_before = len(starts(self.scratch))
        self._until(lambda: len(starts(self.scratch)) > begun_before)
        time.sleep(self.chance.uniform(0, 2 * HOLD))
        kind = self.chance.choice(KINDS)
        getattr(self, f"_kill_{kind}")()
        self.killed[kind] += 1

    def end(self) -> None:
        """Wait undisturbed for some chunks, and stop the driver."""
        begun_before = len(starts(self.scratch))
        self._until(lambda: len(starts(self.scratch)) > begun_before + 4 * NODES)
        _stop(self.scratch).touch()
        if code := self.driver.wait(timeout=DEADLINE):
            raise RuntimeError(f"the driver has failed with exit code {code}:\n{self._log.read_text()[-2000:]}")

    def close(self) -> None:
        """End all processes."""
        self.driver.kill()
        self.driver.wait()
        self.cluster.shutdown()

    def _kill_driver(self) -> None:
        self.driver.kill()
        self.driver.wait()
        appended = self.appended()
        self.open_at_driver_kill.append(len({at for at, _ in starts(self.scratch) if at >= appended}))
        self.driver = self._start()

    def _kill_worker(self) -> None:
        """One of the workers that started a chunk last."""
        self._until(self._try_to_kill_worker)

    def _try_to_kill_worker(self) -> bool:
        pids = [pid for _, pid in starts(self.scratch)][-NODES:]
        for pid in self.chance.sample(pids, len(pids)):
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
                return True
        return False

    def _kill_node(self) -> None:
        node = self.nodes.pop(self.chance.randrange(NODES))
        self.cluster.remove_node(node, allow_graceful=False)
        self.nodes.append(self.cluster.add_node(num_cpus=1))

    def _start(self) -> subprocess.Popen:
        command = [sys.executable, "-m", "benchmarks.tournaments.tournament_kills", str(self.scratch)]
        with self._log.open("a") as log:
            return subprocess.Popen([*command, self.cluster.address], stdout=log, stderr=log)

    @property
    def _log(self) -> Path:
        return self.scratch / "driver.log"

    def _until(self, condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + DEADLINE
        while not condition():
            if self.driver.poll() is not None:
                raise RuntimeError(f"the driver has ended by itself:\n{self._log.read_text()[-2000:]}")
            if time.monotonic() > deadline:
                raise TimeoutError(f"the tournament has not gone on within {DEADLINE:g} s")
            time.sleep(0.02)


def starts(scratch: Path) -> list[tuple[int, int]]:
    """(first position, process) of each started chunk, in order."""
    try:
        text = (scratch / "starts").read_text()
    except FileNotFoundError:
        return []
    lines = [line.split() for line in text.splitlines()]
    return [(int(position), int(pid)) for position, pid in lines]


def _drive(scratch: Path, address: str) -> None:
    """Play until the stop file exists. Runs in a subprocess."""
    ray.init(address=address, log_to_driver=False, logging_level="ERROR")
    registry = Registry.open(Storage.at(scratch / "home"))
    (schedule,) = Ledger(registry).schedules(LEAGUE)
    log = str(scratch / "starts")

    @ray.remote(num_cpus=1, max_retries=tournament.RETRIES)
    def record_and_play(job: tuple[Schedule, Storage, str, dict[str, str]], chunk: range) -> tuple[str, list[Match]]:
        # One short line, appended in a single write: complete or absent.
        descriptor = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        os.write(descriptor, f"{chunk.start} {os.getpid()}\n".encode())
        os.close(descriptor)
        time.sleep(HOLD)
        schedule, storage, config, _ = job
        return ray.get_runtime_context().get_node_id(), match_worker(storage, config).play(schedule, chunk)

    tournament._play_chunk = record_and_play  # type: ignore[assignment]
    tournament.play_schedule(schedule, registry=registry, workers=NODES, enough=lambda _: _stop(scratch).exists())


def _stop(scratch: Path) -> Path:
    return scratch / "stop"


def _results(registry: Registry, schedule: Schedule, experiment: _Experiment) -> Iterator[Target]:
    matches = Ledger(registry).matches(league=LEAGUE, schedule=schedule.id)
    document = registry.leagues.get(LEAGUE).config.model_dump_json(by_alias=True)
    expected = match_worker(registry.storage, document).play(schedule, range(len(matches)))
    positions = Counter(match.position for match in matches)
    counts = {
        "lost": len(set(range(len(matches))) - set(positions)),
        "duplicated": sum(count - 1 for count in positions.values()),
        "different": sum(match != undisturbed for match, undisturbed in zip(matches, expected, strict=True)),
    }
    kills = ", ".join(f"{experiment.killed[kind]} of a {kind}" for kind in KINDS)
    name = f"kills: matches {', '.join(counts)}"
    yield Target(name, tuple(counts.values()), at_most=0, note=f"of {len(matches):,}; {kills}")
    most = max(experiment.open_at_driver_kill, default=0)
    yield Target("kills: open chunks at a driver's death", most, at_most=NODES)
    chunk_starts = starts(experiment.scratch)
    again = len(chunk_starts) - len({position for position, _ in chunk_starts})
    allowed = sum(experiment.open_at_driver_kill) + experiment.killed["worker"] + experiment.killed["node"]
    yield Target("kills: chunks started again", again, at_most=allowed)


if __name__ == "__main__":
    _drive(Path(sys.argv[1]), sys.argv[2])
