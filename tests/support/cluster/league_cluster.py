"""A Ray cluster of a head and workers with a PostgreSQL and a Redis, each on a machine of its own."""

import re
import secrets
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from tests.support.cluster import slow_bot
from tests.support.cluster.machines import ROOT, Machine, network
from tests.support.servers import postgresql
from tests.support.waiting import until

HEAD, WORKERS = "head", ("worker1", "worker2")
LEAGUE = str(Path(sys.executable).with_name("league"))
RAY = str(Path(sys.executable).with_name("ray"))
OBJECT_STORE = 80_000_000
START_TIMEOUT = 240.0
"""Seconds for a node to join, on a busy machine."""
DRAIN_SECONDS = 60
QUICK_HEALTH_CHECKS = {
    "RAY_health_check_initial_delay_ms": "2000",
    "RAY_health_check_period_ms": "1000",
    "RAY_health_check_timeout_ms": "2000",
    "RAY_health_check_failure_threshold": "5",
}
"""The head declares a machine dead that does not answer for some seconds. By default it takes half a minute."""


def obstacle() -> str | None:
    """Why there can be no cluster here, None if there can."""
    from shutil import which

    from tests.support.cluster import machines

    if postgresql.programs() is None:
        return "a cluster needs PostgreSQL: install the package postgresql"
    if which("redis-server") is None:
        return "a cluster needs Redis: install the package redis-server"
    return machines.obstacle()


@dataclass
class LeagueCluster:
    """The machines, and the environment of all their processes."""

    machines: dict[str, Machine]
    environment: Mapping[str, str]
    cpus: int

    @property
    def head(self) -> Machine:
        """The machine of Ray's head, which runs no replica and no game."""
        return self.machines[HEAD]

    @property
    def address(self) -> str:
        """The address of the Ray cluster."""
        return f"{self.head.address}:6379"

    def start_head(self) -> None:
        """Start Ray's head, whose state is in Redis."""
        redis = {"RAY_REDIS_ADDRESS": f"{self.machines['redis'].address}:6379"}
        options = ("--head", "--port", "6379", "--num-cpus", "0", "--include-dashboard", "false")
        self._start_node(self.head, options, redis | QUICK_HEALTH_CHECKS)

    def start_worker(self, name: str, environment: Mapping[str, str] | None = None) -> None:
        """Start a worker, which joins the cluster."""
        options = ("--address", self.address, "--num-cpus", str(self.cpus))
        self._start_node(self.machines[name], options, environment or {})

    def drain(self, name: str) -> None:
        """Ask a worker's Ray to finish what it does and then to end, as before the machine is taken away."""
        reason = ("--reason", "DRAIN_NODE_REASON_PREEMPTION", "--reason-message", "test")
        options = (*reason, "--deadline-remaining-seconds", str(DRAIN_SECONDS))
        self.machines[name].check_run(RAY, "drain-node", *options, environment=self.environment)

    @contextmanager
    def slow_bots(self) -> Iterator[None]:
        """While the context lasts, `slow_bot` plays slowly."""
        file = Path(self.environment[slow_bot.FILE])
        file.touch()
        try:
            yield
        finally:
            file.unlink()

    def league(self, machine: Machine, *arguments: str, timeout: float = START_TIMEOUT) -> str:
        """Run a `league` command that must succeed; returns its output."""
        return machine.check_run(LEAGUE, *arguments, environment=self.environment, timeout=timeout)

    def run_league(self, machine: Machine, *arguments: str) -> "subprocess.CompletedProcess[str]":
        """Run a `league` command that may fail."""
        return machine.run(LEAGUE, *arguments, environment=self.environment, timeout=START_TIMEOUT)

    def with_database(self, name: str) -> "LeagueCluster":
        """Return the same cluster whose commands use another database."""
        url = self.environment["LEAGUE_DATABASE_URL"].rpartition("/")[0]
        return replace(self, environment={**self.environment, "LEAGUE_DATABASE_URL": f"{url}/{name}"})

    def sql(self, statement: str, database: str = "postgres") -> str:
        """Run a statement in the database; returns its rows."""
        machine = self.machines["database"]
        options = ("-h", machine.address, "-U", postgresql.USER, "-d", database, "-v", "ON_ERROR_STOP=1", "-At")
        return machine.check_run("psql", *options, "-c", statement)

    def start_league(self, machine: Machine, *arguments: str) -> "subprocess.Popen[str]":
        """Start a `league` command. Its output goes to the machine's log."""
        return machine.start(LEAGUE, *arguments, environment=self.environment)

    def _start_node(self, machine: Machine, options: tuple[str, ...], environment: Mapping[str, str]) -> None:
        machine.check_run("mkdir", "-p", self.environment["LEAGUE_HOME"])
        common = ("--node-ip-address", machine.address, "--object-store-memory", str(OBJECT_STORE))
        command = (RAY, "start", *options, *common, "--disable-usage-stats")
        deadline = time.monotonic() + START_TIMEOUT
        # `ray start` gives up after 30 s, which a busy machine may exceed.
        environment = {**self.environment, **environment}
        while (done := machine.run(*command, environment=environment, timeout=START_TIMEOUT)).returncode:
            assert time.monotonic() < deadline, done.stdout + machine.log.read_text()[-3000:]


@contextmanager
def cluster(directory: Path, cpus: int = 2) -> Iterator[LeagueCluster]:
    """A running cluster. directory: a folder that all machines share; cpus: of each worker."""
    names = ("database", "redis", HEAD, *WORKERS, "client")
    with network(names, directory) as machines:
        _start_database(machines["database"])
        _start_redis(machines["redis"])
        running = LeagueCluster(machines, _environment(machines["database"], directory), cpus)
        running.start_head()
        for name in WORKERS:
            running.start_worker(name)
        yield running


def _environment(database: Machine, directory: Path) -> dict[str, str]:
    """The environment that deploy.yaml lists for each node. Each machine has its own home."""
    text = (ROOT / "deploy.yaml").read_text()
    listed = dict(re.findall(r"^#\s+export (\w+)=\"?([^\"#\n]*?)\"?\s*(?:#.*)?$", text, flags=re.M))
    return listed | {
        "LEAGUE_HOME": "/tmp/league-home",
        "LEAGUE_ARTIFACTS": str(directory / "artifacts"),
        "LEAGUE_DATABASE_URL": f"postgresql+psycopg://{postgresql.USER}@{database.address}/postgres",
        "RAY_SERVE_HAPROXY_BINARY_PATH": str(Path(sys.executable).with_name("league-haproxy")),
        "RAY_AUTH_TOKEN": secrets.token_hex(16),
        "PYTHONPATH": str(ROOT),
        slow_bot.FILE: str(directory / "slow"),
        "RAY_DISABLE_DOCKER_CPU_WARNING": "1",
        "NO_COLOR": "1",
        "COLUMNS": "200",
    }


def _start_database(machine: Machine) -> None:
    """Start PostgreSQL, which does not run as root."""
    binaries = postgresql.programs()
    assert binaries is not None
    network = machine.address.rpartition(".")[0]
    script = f"""
        umask 077; cd /tmp
        {binaries}/initdb -D data -U {postgresql.USER} -A trust -E UTF8 --no-sync > /dev/null
        echo 'host all all {network}.0/24 trust' >> data/pg_hba.conf
        exec {binaries}/postgres -D data -k /tmp -c listen_addresses={machine.address} -c fsync=off
    """
    machine.start("setpriv", "--reuid", "postgres", "--regid", "postgres", "--clear-groups", "sh", "-c", script)
    connect = f"import psycopg; psycopg.connect('host={machine.address} user={postgresql.USER} dbname=postgres')"
    until(lambda: machine.run(sys.executable, "-c", connect).returncode == 0, 60)


def _start_redis(machine: Machine) -> None:
    options = ("--bind", machine.address, "--protected-mode", "no", "--save", "", "--appendonly", "no")
    machine.start("redis-server", *options)
    ping = ("redis-cli", "-h", machine.address, "ping")
    until(lambda: machine.run(*ping).stdout == "PONG\n", 60)
