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

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import ray
from ray.cluster_utils import Cluster

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


def main(argv: Sequence[str] | None = None) -> int:
    """Print the kills and the result; 1 if a target was missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="smoke test: 10 kills")
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0, help="seed of the kills")
    parser.add_argument("--drive", nargs=2, metavar=("SCRATCH", "ADDRESS"), help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    if options.drive:
        _drive(Path(options.drive[0]), options.drive[1])
        return 0
    return run_with_kills(10 if options.quick else options.kills, options.seed)


def run(quick: bool = False) -> int:
    """Run the benchmark with its usual settings."""
    return run_with_kills(10 if quick else 100, seed=0)


def run_with_kills(kills: int, seed: int) -> int:
    """Kill `kills` times; 1 if anything was lost, duplicated or different, or too much was repeated."""
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as scratch:
        registry, schedule = _open(Path(scratch))
        experiment = _Experiment(
            Path(scratch), random.Random(seed), lambda: len(Ledger(registry).positions(schedule.id))
        )
        try:
            for _ in range(kills):
                experiment.kill_one()
            experiment.end()
        finally:
            experiment.close()
        return _report(registry, schedule, experiment, time.perf_counter() - began)


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
    contestants = [*baselines(interface(config)), "script:first"]
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
        known = len(starts(self.scratch))
        self._until(lambda: len(starts(self.scratch)) > known)
        time.sleep(self.chance.uniform(0, 2 * HOLD))
        kind = self.chance.choice(KINDS)
        getattr(self, f"_kill_{kind}")()
        self.killed[kind] += 1

    def end(self) -> None:
        """Wait undisturbed for some chunks, and stop the driver."""
        known = len(starts(self.scratch))
        self._until(lambda: len(starts(self.scratch)) > known + 4 * NODES)
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
        command = [sys.executable, "-m", "benchmarks.tournaments.tournament_kills", "--drive", str(self.scratch)]
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


def _report(registry: Registry, schedule: Schedule, experiment: _Experiment, seconds: float) -> int:
    found = Ledger(registry).matches(league=LEAGUE, schedule=schedule.id)
    document = registry.leagues.get(LEAGUE).config.model_dump_json(by_alias=True)
    expected = match_worker(registry.storage, document).play(schedule, range(len(found)))
    positions = Counter(match.position for match in found)
    lost = len(set(range(len(found))) - set(positions))
    doubled = sum(count - 1 for count in positions.values())
    different = sum(one != other for one, other in zip(found, expected, strict=True))
    chunk_starts = starts(experiment.scratch)
    again = len(chunk_starts) - len({position for position, _ in chunk_starts})
    most = max(experiment.open_at_driver_kill, default=0)
    allowed = sum(experiment.open_at_driver_kill) + experiment.killed["worker"] + experiment.killed["node"]
    named = ", ".join(f"{experiment.killed[kind]} of a {kind}" for kind in KINDS)
    print(f"{experiment.killed.total()} kills: {named}; {len(found):,} matches in {seconds:.0f} s")
    print("lost | doubled | different | open chunks at a driver's death, at most | chunks started again | target")
    met = bool(found) and not (lost or doubled or different) and most <= NODES and again <= allowed
    print(
        f"{lost} | {doubled} | {different} | {most} of {NODES} | {again} of at most {allowed}"
        f" | {'met' if met else 'MISSED (0, 0, 0, one per worker)'}"
    )
    registry.close()
    return int(not met)


if __name__ == "__main__":
    sys.exit(main())
