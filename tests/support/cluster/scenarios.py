"""What happens to a cluster, and what was measured: nodes that are killed, cut off, added and removed.

The slow tests assert the results, and `benchmarks/cluster.py` prints them.
"""

import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from tests.support.cluster.league_cluster import HEAD, START_TIMEOUT, WORKERS, LeagueCluster
from tests.support.cluster.machines import Machine, end
from tests.support.waiting import until

LEAGUE = "tictactoe"
TRAINING = {"steps": 4096, "runners": 2, "train_batch_size": 512, "minibatch_size": 256, "epochs": 1, "num_envs": 4}
SETTINGS = {"hidden": [16], "seed": 5, "checkpoint_every": 2048}
SLOW_BOT = "script:tests.support.cluster.slow_bot:act"
TOURNAMENT = (LEAGUE, f"{LEAGUE}@1", f"{LEAGUE}@2", "--schedule", "gauntlet", "--against", SLOW_BOT, "--seed", "7")
LOST, SURVIVOR = WORKERS
BOTH = "Training on 2 of 2 nodes, 3 of 4 CPUs."
ONE = "Training on 1 of 1 nodes, 1.98 of 2 CPUs."


@dataclass(frozen=True)
class Changes:
    """What happened when nodes came and went. Times are seconds.

    continued: from the loss of a worker until work went on. used: from when the worker had joined again until it was
    used. drained: from the request to drain it until its Ray had ended.
    """

    continued: float
    used: float
    drained: float


def write_config(directory: Path, **training: Any) -> Path:
    """The league's file."""
    path = directory / f"{LEAGUE}.yaml"
    document = {
        "league": LEAGUE,
        "environment": {"entry_point": "pettingzoo.classic.tictactoe_v3"},
        "play": {"num_envs": 4},  # chunks of at most 16 games
        "training": TRAINING | SETTINGS | training,
    }
    path.write_text(yaml.safe_dump(document))
    return path


def train(cluster: LeagueCluster, directory: Path) -> str:
    """Train with the driver on the head, which has no CPU for the learner. Returns the command's output."""
    config = str(write_config(directory))
    return cluster.league(cluster.head, "train", config, "--address", cluster.address, timeout=2 * START_TIMEOUT)


def change_nodes_while_training(cluster: LeagueCluster, directory: Path) -> tuple[Changes, list[int]]:
    """Kill a worker, let it join again and drain it; returns also the steps of all versions of the run."""
    config, log = str(write_config(directory, steps=10**7, checkpoint_every=8192)), Log(cluster.head)
    training = cluster.start_league(cluster.head, "train", config, "--address", cluster.address)
    log.wait_for(BOTH)
    log.wait_for("Published ")
    cluster.machines[LOST].kill()
    killed = time.monotonic()
    log.wait_for("nodes were lost")
    log.wait_for(ONE)
    continued = time.monotonic() - killed
    restart(cluster, LOST)
    joined = time.monotonic()
    log.wait_for("Nodes have joined. Training continues.")
    log.wait_for(BOTH)
    used = time.monotonic() - joined
    drained = drain(cluster, LOST)
    log.wait_for("1 of 2 nodes are drained. Training continues.")
    log.wait_for(ONE)
    end(training, START_TIMEOUT)
    restart(cluster, LOST)
    published = log.found(r"Published \S+ after ([\d,]+) steps")
    return Changes(continued, used, drained), [int(steps.replace(",", "")) for steps in published]


class Log:
    """What a machine's programs print from now on."""

    def __init__(self, machine: Machine) -> None:
        self._file = machine.log
        self._begin = self._seen = len(self._file.read_text())

    def wait_for(self, sentence: str) -> None:
        """Wait for a sentence after those that were waited for before."""
        until(lambda: sentence in self._file.read_text()[self._seen :], 2 * START_TIMEOUT)
        self._seen = self._file.read_text().index(sentence, self._seen) + len(sentence)

    def found(self, pattern: str) -> list[str]:
        """All matches of a pattern."""
        return re.findall(pattern, self._file.read_text()[self._begin :])


def restart(cluster: LeagueCluster, name: str) -> None:
    """Start a machine again that was killed; it joins the cluster as a new node."""
    machine = cluster.machines[name]
    machine.boot(machine.switch)
    if name == HEAD:
        cluster.start_head()
    else:
        cluster.start_worker(name)


def drain(cluster: LeagueCluster, name: str) -> float:
    """Drain a worker, as before a preemption, and turn it off; returns how long its Ray needed to end."""
    machine, began = cluster.machines[name], time.monotonic()
    cluster.drain(name)
    until(lambda: not machine.runs("raylet/raylet"), START_TIMEOUT)
    seconds = time.monotonic() - began
    machine.kill()
    return seconds


def change_nodes_during_tournament(cluster: LeagueCluster, blocks: int) -> tuple[Changes, str, str]:
    """Kill a worker, let it join again and drain it during a tournament.

    Returns also the tournament's ledger and that of an undisturbed one.
    """
    cluster.sql("CREATE DATABASE undisturbed TEMPLATE postgres", "template1")
    command = ("evaluate", *TOURNAMENT, "--blocks", str(blocks))
    with cluster.slow_bots():
        tournament = cluster.start_league(cluster.head, *command, "--address", cluster.address)
        until(lambda: _played(cluster) > 0, 2 * START_TIMEOUT)
        until(lambda: _plays(cluster, LOST), START_TIMEOUT)
        cluster.machines[LOST].kill()
        killed, before = time.monotonic(), _played(cluster)
        until(lambda: _played(cluster) > before, START_TIMEOUT)
        continued = time.monotonic() - killed
        restart(cluster, LOST)
        joined, log = time.monotonic(), Log(cluster.head)
        until(lambda: _plays(cluster, LOST), START_TIMEOUT)
        used = time.monotonic() - joined
        log.wait_for("2 nodes, 4 CPUs")
        drained = drain(cluster, LOST)
        log.wait_for("1 node, 2 CPUs")
        assert tournament.poll() is None, "the tournament was too short"
    assert tournament.wait(2 * START_TIMEOUT) == 0, cluster.head.log.read_text()[-3000:]
    cluster.with_database("undisturbed").league(cluster.machines[SURVIVOR], *command, "--workers", "0")
    restart(cluster, LOST)
    return Changes(continued, used, drained), ledger(cluster), ledger(cluster, "undisturbed")


def _played(cluster: LeagueCluster) -> int:
    return int(cluster.sql("SELECT count(*) FROM matches"))


def _plays(cluster: LeagueCluster, name: str) -> bool:
    """Whether a worker plays a chunk of a tournament."""
    return cluster.machines[name].runs("ray::_play_chunk")


def ledger(cluster: LeagueCluster, database: str = "postgres") -> str:
    """All matches of a database, without their times."""
    columns = "schedule, position, first, second, games, scores, returns, moves"
    return cluster.sql(f"SELECT {columns} FROM matches ORDER BY schedule, position", database)


def join_with_another_version(cluster: LeagueCluster, directory: Path, package: str, version: str) -> str:
    """Let a machine join whose `package` has another version; returns what an evaluation prints."""
    machine, stack = cluster.machines["client"], directory / "other-stack"
    metadata = stack / f"{package}-{version}.dist-info" / "METADATA"
    metadata.parent.mkdir(parents=True)
    metadata.write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: {version}\n")
    cluster.start_worker("client", {"PYTHONPATH": f"{stack}:{cluster.environment['PYTHONPATH']}"})
    command = ("evaluate", *TOURNAMENT, "--blocks", "2", "--workers", "2", "--address", cluster.address)
    refused = cluster.run_league(cluster.head, *command)
    machine.kill()
    machine.boot(machine.switch)
    assert refused.returncode != 0, refused.stdout
    return refused.stdout + cluster.head.log.read_text()
