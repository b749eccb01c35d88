"""What happens to a cluster, and what was measured: nodes that are killed, cut off, added and removed.

The slow tests assert the results, and `benchmarks/cluster.py` prints them.
"""

import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from tests.support.cluster.league_cluster import HEAD, START_TIMEOUT, WORKERS, LeagueCluster
from tests.support.cluster.machines import Machine, end
from tests.support.waiting import until

LEAGUE = "tictactoe"
REPLICAS = 4
THREADS = 2
AFTERWARDS = 20.0
"""Seconds of load after the head is back: it must not replace replicas."""
SETTLED = 3.0
"""Seconds after which all replicas have answered many calls."""
TRAINING = {"steps": 4096, "runners": 2, "train_batch_size": 512, "minibatch_size": 256, "epochs": 1, "num_envs": 4}
SETTINGS = {"hidden": [16], "seed": 5, "checkpoint_every": 2048}
PORT = 8000
CONTESTANTS = (f"{LEAGUE}@1", f"{LEAGUE}@2", "script:random")
LOST, SURVIVOR = WORKERS


@dataclass(frozen=True)
class Load:
    """What callers see while something happens. Times are seconds since the epoch."""

    file: Path

    @property
    def report(self) -> dict[str, Any]:
        """The report of `caller.py` so far."""
        return dict(json.loads(self.file.read_text())) if self.file.exists() else {"replicas": {}, "versions": {}}

    @property
    def lost(self) -> list[str]:
        """Calls of the client that failed in spite of its retries."""
        return list(self.report["lost"])

    @property
    def attempts_lost(self) -> list[str]:
        """Single attempts that failed."""
        return list(self.report["attempts_lost"])

    def versions(self) -> list[str]:
        """The versions that answered, in the order of their first answers."""
        found = self.report["versions"]
        return sorted(found, key=lambda version: float(found[version][0]))

    def followed(self, version: int) -> float:
        """When a version other than this one answered for the last time."""
        return max(float(last) for other, (_, last) in self.report["versions"].items() if other != str(version))

    def new_replicas(self, since: float) -> list[float]:
        """When replicas that had not answered before `since` answered first."""
        return sorted(first for first, _ in self.report["replicas"].values() if first > since)

    def wait_for_replicas(self, since: float = 0) -> None:
        """Wait until REPLICAS have answered since a time."""
        until(lambda: sum(last > since for _, last in self.report["replicas"].values()) >= REPLICAS, START_TIMEOUT)

    def wait_for_version(self, version: int) -> None:
        """Wait until a version answers, and no other has for SETTLED seconds."""
        until(lambda: str(version) in self.report["versions"], START_TIMEOUT)
        until(lambda: time.time() > self.followed(version) + SETTLED, START_TIMEOUT)


def write_config(directory: Path, **training: Any) -> Path:
    """The league's file."""
    path = directory / f"{LEAGUE}.yaml"
    document = {
        "league": LEAGUE,
        "environment": {"entry_point": "pettingzoo.classic.tictactoe_v3"},
        "training": TRAINING | SETTINGS | training,
    }
    path.write_text(yaml.safe_dump(document))
    return path


def train(cluster: LeagueCluster, directory: Path) -> str:
    """Train with the driver on the head, which has no CPU for the learner. Returns the command's output."""
    config = str(write_config(directory))
    return cluster.league(cluster.head, "train", config, "--address", cluster.address, timeout=2 * START_TIMEOUT)


def lose_worker_while_training(cluster: LeagueCluster, directory: Path) -> float:
    """Kill a worker during training; returns the seconds until the next version is published."""
    config = str(write_config(directory, steps=10**7))
    before = _published(cluster.head)
    training = cluster.start_league(cluster.head, "train", config, "--address", cluster.address)
    until(lambda: _published(cluster.head) > before, 2 * START_TIMEOUT)
    cluster.machines[LOST].kill()
    killed, before = time.monotonic(), _published(cluster.head)
    log = cluster.head.log
    until(lambda: "Training continues." in log.read_text() and _published(cluster.head) > before, START_TIMEOUT)
    seconds = time.monotonic() - killed
    end(training, START_TIMEOUT)
    restart(cluster, LOST)
    return seconds


def _published(machine: Machine) -> int:
    return machine.log.read_text().count(f"Published {LEAGUE}@")


def restart(cluster: LeagueCluster, name: str) -> None:
    """Start a machine again that was killed; it joins the cluster as a new node."""
    machine = cluster.machines[name]
    machine.boot(machine.switch)
    if name == HEAD:
        cluster.start_head()
    else:
        cluster.start_worker(name)


def evaluate(cluster: LeagueCluster, machine: Machine, blocks: int, *options: str, database: str = "postgres") -> None:
    """Play a tournament."""
    command = ("evaluate", LEAGUE, *CONTESTANTS, "--blocks", str(blocks), "--seed", "7", *options)
    cluster.with_database(database).league(machine, *command, timeout=2 * START_TIMEOUT)


def ledger(cluster: LeagueCluster, database: str = "postgres") -> str:
    """All matches of a database, without their times."""
    columns = "schedule, position, first, second, games, scores, returns, moves"
    return cluster.sql(f"SELECT {columns} FROM matches ORDER BY schedule, position", database)


def lose_worker_during_tournament(cluster: LeagueCluster, blocks: int) -> tuple[str, str]:
    """Kill a worker during a tournament; returns its ledger and that of an undisturbed tournament."""
    cluster.sql("CREATE DATABASE undisturbed TEMPLATE postgres", "template1")
    tournament = cluster.start_league(
        cluster.head,
        *("evaluate", LEAGUE, *CONTESTANTS, "--blocks", str(blocks), "--seed", "7"),
        *("--workers", "3", "--address", cluster.address),
    )
    count = "SELECT count(*) FROM matches"
    until(lambda: int(cluster.sql(count)) > 0, 2 * START_TIMEOUT)
    cluster.machines[LOST].kill()
    assert tournament.wait(2 * START_TIMEOUT) == 0, cluster.head.log.read_text()[-3000:]
    evaluate(cluster, cluster.machines[SURVIVOR], blocks, "--workers", "0", database="undisturbed")
    restart(cluster, LOST)
    return ledger(cluster), ledger(cluster, "undisturbed")


@contextmanager
def serving(cluster: LeagueCluster) -> Iterator[str]:
    """Serve on all nodes; yields an API key."""
    scopes = ("--scope", "act", "--scope", "read")
    token = json.loads(cluster.league(cluster.head, "keys", "create", "clients", *scopes, "--json"))["key"]
    options = ("--host", "0.0.0.0", "--replicas", str(REPLICAS), "--address", cluster.address)
    server = cluster.start_league(cluster.head, "serve", *options)
    try:
        until(lambda: "Serving" in cluster.head.log.read_text() or server.poll() is not None, 2 * START_TIMEOUT)
        assert server.poll() is None, cluster.head.log.read_text()[-3000:]
        yield token
    finally:
        end(server, 60)


@contextmanager
def load(cluster: LeagueCluster, key: str, through: str = SURVIVOR) -> Iterator[Load]:
    """Call the server through one machine's HAProxy while the context lasts, from when all replicas have answered."""
    client = cluster.machines["client"]
    found = Load(client.log.with_name(f"caller-{time.time_ns()}.json"))
    url = f"http://{cluster.machines[through].address}:{PORT}"
    program = (sys.executable, "-m", "tests.support.cluster.caller", url, key, LEAGUE, str(THREADS), str(found.file))
    process = client.start(*program, environment=cluster.environment)
    try:
        found.wait_for_replicas()
        yield found
    finally:
        end(process, 120)


def lose_worker_while_serving(cluster: LeagueCluster, key: str) -> tuple[Load, float]:
    """Kill a worker under load until as many replicas answer again; returns the load and when it was killed."""
    with load(cluster, key) as calls:
        cluster.machines[LOST].kill()
        killed = time.time()
        calls.wait_for_replicas(since=killed)
    restart(cluster, LOST)
    return calls, killed


def lose_head(cluster: LeagueCluster, key: str, version: int, seconds: float) -> tuple[Load, float, float]:
    """Kill the head, promote a version meanwhile, start it again; returns the load, the kill and the promotion."""
    with load(cluster, key) as calls:
        cluster.head.kill()
        killed = time.time()
        promoted = promote(cluster, cluster.machines[SURVIVOR], version)
        calls.wait_for_version(version)
        until(lambda: time.time() >= killed + seconds, seconds + START_TIMEOUT)
        restart(cluster, HEAD)
        returned = time.time()
        until(lambda: time.time() >= returned + AFTERWARDS, 2 * AFTERWARDS)
    return calls, killed, promoted


def cut_off_database(cluster: LeagueCluster, key: str, version: int, seconds: float) -> tuple[Load, float]:
    """Cut the database off, and promote on its machine meanwhile; returns the load and the end of the partition."""
    database = cluster.machines["database"]
    with load(cluster, key) as calls:
        began = time.time()
        with database.unplugged():
            promote(cluster, database, version)
            until(lambda: time.time() >= began + seconds, seconds + START_TIMEOUT)
        restored = time.time()
        calls.wait_for_version(version)
    return calls, restored


def promote(cluster: LeagueCluster, machine: Machine, version: int) -> float:
    """Promote a version by a command on a machine; returns when it took effect."""
    cluster.league(machine, "promote", f"{LEAGUE}@{version}", "--reason", "test")
    return float(cluster.sql("SELECT extract(epoch FROM max(at)) FROM alias_events"))


def join_with_another_version(cluster: LeagueCluster, directory: Path, package: str, version: str) -> str:
    """Let a machine join whose `package` has another version; returns what an evaluation prints."""
    machine, stack = cluster.machines["client"], directory / "other-stack"
    metadata = stack / f"{package}-{version}.dist-info" / "METADATA"
    metadata.parent.mkdir(parents=True)
    metadata.write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: {version}\n")
    cluster.start_worker("client", {"PYTHONPATH": f"{stack}:{cluster.environment['PYTHONPATH']}"})
    command = ("evaluate", LEAGUE, *CONTESTANTS, "--blocks", "2", "--workers", "2", "--address", cluster.address)
    refused = cluster.run_league(cluster.head, *command)
    machine.kill()
    machine.boot(machine.switch)
    assert refused.returncode != 0, refused.stdout
    return refused.stdout + cluster.head.log.read_text()
