"""Connects this process to Ray: starts a local Ray, or joins a running cluster."""

from __future__ import annotations

import logging
import math
import os
import signal
import socket
import threading
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from league.errors import ConfigError, NotReady, one_line
from league.interruption import hangup_blocked
from league.local_ray.loopback_node import (
    LIMITS,
    WAITING_WORKERS,
    WITHOUT_AGENTS,
    StartFailed,
    loopback_addresses,
    loopback_node,
)
from league.local_ray.token import create_token, forget_token
from league.settings import Storage
from league.stack import difference, installed_with_this

CGROUP = Path("/sys/fs/cgroup")
NODE_POLL = 0.5
"""Seconds."""
NODE_TIMEOUT = 60.0
"""Seconds for a node to start a process and answer."""
CONNECT_TIMEOUT = 10.0
"""Seconds for a TCP connection to a cluster. Ray itself would retry for minutes."""
DRAINING = "DRAINING"
NO_AUTOSCALER = (None, "0")
"""Versions of the state of an autoscaler that does not run."""
SAME_VERSIONS = "install the same versions on all machines (constraints.txt)"
ATTEMPTS = 3
"""Starts of a local Ray of which a process ends."""
MIN_OBJECT_STORE = 80
"""MB. Ray refuses less than 75 MiB."""


@dataclass(frozen=True, slots=True)
class LocalRay:
    """Resources of a local Ray; None for Ray's default. Raises ConfigError if Ray does not support them.

    Attributes:
        cpus: Number of CPUs.
        object_store: Shared memory in MB, at least MIN_OBJECT_STORE.
        dashboard: Whether to start Ray's dashboard.
        runtime_envs: Whether tasks may have runtime environments, for which an agent starts.
        preload: A module that workers import before they have a task. One worker per CPU starts with the node.
    """

    cpus: int | None = None
    object_store: int | None = None
    dashboard: bool = False
    runtime_envs: bool = False
    preload: str | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        if self.object_store is not None and self.object_store < MIN_OBJECT_STORE:
            raise ConfigError(f"--object-store: at least {MIN_OBJECT_STORE} MB, got {self.object_store}")


UNLIMITED = LocalRay()
OF_DASHBOARD = ("aiohttp", "aiohttp_cors", "opencensus", "prometheus_client")
"""Packages of the extra `ray[default]` without which Ray starts no dashboard."""

PRELOAD = "RAY_preload_python_modules"
"""Ray's environment variable."""
SPIN_COUNT = "3000"
"""How often a thread of torch looks for work before it sleeps. With the default of GNU OpenMP, 300,000, threads that
wait take the cores from those that work: if other programs use the cores too, an update took eleven times as long as
with one thread. With this number it takes no longer, and is nearly as fast on idle cores."""


def usable_cpus() -> int:
    """Return the number of CPUs that this process may use: at least one, and no more than its container has."""
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    with suppress(OSError, ValueError):  # no control groups, or `max`
        if (limit := CGROUP / "cpu.max").exists():  # version 2
            quota, period = limit.read_text().split()
        else:
            quota, period = ((CGROUP / "cpu" / f"cpu.cfs_{name}_us").read_text() for name in ("quota", "period"))
        if int(quota) > 0:
            return max(1, math.ceil(min(allowed, int(quota) / int(period))))
    return max(1, allowed)


def start_local(local: LocalRay = UNLIMITED, **options: Any) -> str | None:
    """Start a local Ray on the loopback interface, and return the address of its dashboard, if it has one.

    options: further arguments of `ray.init`. Raises ConfigError if the dashboard is not installed, and NotReady if Ray
    does not start.
    """
    import ray

    if local.dashboard and (missing := [name for name in OF_DASHBOARD if find_spec(name) is None]):
        raise ConfigError(f"--dashboard needs {missing[0]}: pip install 'ray[default]=={ray.__version__}'")
    os.environ.setdefault("GOMP_SPINCOUNT", SPIN_COUNT)  # inherited by all processes of Ray
    create_token()
    for attempt in range(ATTEMPTS):
        try:
            with hangup_blocked(), _node_variables(local), loopback_node(local.runtime_envs or local.dashboard):
                dashboard = _connect(
                    address="local",
                    num_cpus=local.cpus,
                    object_store_memory=None if local.object_store is None else local.object_store * 10**6,
                    include_dashboard=local.dashboard,
                    **options,
                )
            break
        except StartFailed as error:  # another program may have taken a port
            if attempt == ATTEMPTS - 1:
                raise NotReady(f"Ray did not start: {error}") from error
        except Exception as error:
            remedy = ": set RAY_TMPDIR to a shorter path, such as /tmp" if "AF_UNIX path length" in str(error) else ""
            raise NotReady(f"Ray did not start: {one_line(error)}{remedy}") from error
    return dashboard


@contextmanager
def _node_variables(local: LocalRay) -> Iterator[None]:
    """Set the environment variables of a node that is started here, unless the user has set them.

    Subprocesses do not inherit them: they may start another node.
    """
    variables = LIMITS if local.dashboard else LIMITS | WITHOUT_AGENTS
    if local.preload is not None:
        variables = variables | {PRELOAD: local.preload} | WAITING_WORKERS
    variables = {name: value for name, value in variables.items() if name not in os.environ}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name in variables:
            del os.environ[name]


def join(address: str, **options: Any) -> str | None:
    """Join a running cluster and return the address of its dashboard, if it has one.

    address: `HOST:PORT`, or `auto` for the cluster of this machine. options: further arguments of `ray.init`.
    Raises ConfigError if the cluster is unreachable.
    """
    import ray

    host, colon, port = address.rpartition(":")
    try:
        if colon and port.isdigit() and "/" not in host:
            socket.create_connection((host, int(port)), timeout=CONNECT_TIMEOUT).close()
        with loopback_addresses():
            return _connect(address=address, **options)
    except (OSError, ValueError, ray.exceptions.AuthenticationError) as error:
        raise ConfigError(
            f"no Ray cluster at {address!r}: {one_line(error)} (if it requires a token, as `ray start`"
            " does by default: set RAY_AUTH_MODE=token, and RAY_AUTH_TOKEN on other machines)"
        ) from error


def _connect(**options: Any) -> str | None:
    """Call `ray.init` with some arguments, and return the address of the dashboard, if there is one.

    Ray's core puts a handler of SIGTERM before Python's, which prints a stack and aborts the process if that takes 3 s.
    Setting Python's once more removes it.
    """
    import ray

    context = ray.init(log_to_driver=False, logging_level=logging.ERROR, **options)
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))
    return context.dashboard_url


@contextmanager
def ray_session(address: str | None = None) -> Iterator[None]:
    """Disconnect from Ray at the end of the block, unless the process was connected before it.

    address: a cluster to join immediately; None starts nothing. Raises ConfigError if the cluster is unreachable.
    """
    import ray

    is_owner = not ray.is_initialized()
    if is_owner and address is not None:
        join(address)
    try:
        yield
    finally:
        if is_owner and ray.is_initialized():
            ray.shutdown()
            forget_token()


def ensure_local(cpus: int) -> None:
    """Start a local Ray with a number of CPUs if the process is not connected to Ray."""
    import ray

    if not ray.is_initialized():
        start_local(LocalRay(cpus))


@contextmanager
def connected(address: str | None, storage: Storage, local: LocalRay = UNLIMITED) -> Iterator[str | None]:
    """Connect to Ray for the duration of the block, and yield the URL of its dashboard, if it was started or joined.

    address: a cluster to join. None uses the Ray that this process is connected to, or else starts `local`.
    Raises ConfigError if the cluster is unreachable, if its nodes do not share `storage` or have other versions of this
    program or of packages, or if `local` has limits although no local Ray is started.
    """
    import ray

    is_connected = ray.is_initialized()
    if is_connected or address is not None:
        check_unlimited(local)
    with ray_session():
        url = None
        if not is_connected:
            url = start_local(local) if address is None else join(address)
        check_nodes(storage)
        yield f"http://{url}" if url else None


def node_addresses() -> set[str]:
    """Return the IP addresses of the nodes that are alive."""
    return {node["NodeManagerAddress"] for node in alive_nodes()}


def alive_nodes() -> list[dict[str, Any]]:
    """Return Ray's descriptions of the nodes that are alive."""
    import ray

    return [node for node in ray.nodes() if node["Alive"]]


def draining_nodes() -> set[str]:
    """Return Ray's ids of the nodes that are about to leave: they finish what they do, and Ray starts nothing on them.

    Nodes are drained by Ray's autoscaler, by `ray drain-node`, and by the SIGTERM that a preempted pod receives.
    """
    return {node.node_id for node in _cluster_status().active_nodes if node.node_status == DRAINING}


def has_autoscaler() -> bool:
    """Return whether Ray's autoscaler (version 2) adds nodes for what is requested."""
    return _cluster_status().stats.autoscaler_version not in NO_AUTOSCALER


def _cluster_status() -> Any:
    import ray
    from ray.autoscaler.v2.sdk import get_cluster_status

    return get_cluster_status(ray.get_runtime_context().gcs_address)


def usable_nodes() -> list[dict[str, Any]]:
    """Return Ray's descriptions of the nodes on which it starts processes: alive, and not drained."""
    draining = draining_nodes()
    return [node for node in alive_nodes() if node["NodeID"] not in draining]


def cluster_cpus() -> int:
    """Return the number of CPUs of the nodes on which Ray starts processes."""
    return int(sum(node.get("CPU", 0.0) for node in node_resources()))


def node_cpus(nodes: Collection[str]) -> dict[str, float]:
    """Return the CPUs of those of the nodes that are alive. nodes: Ray's ids."""
    return {node["NodeID"]: node["Resources"].get("CPU", 0.0) for node in alive_nodes() if node["NodeID"] in nodes}


def node_ids() -> set[str]:
    """Return Ray's ids of the nodes that are alive. A machine that restarts is another node."""
    return {node["NodeID"] for node in alive_nodes()}


def lost_nodes(before: set[str], seconds: float) -> set[str]:
    """Return those of the nodes `before` that are dead now, or the first that die within `seconds`."""
    deadline = time.monotonic() + seconds
    while not (lost := before - node_ids()) and time.monotonic() < deadline:
        time.sleep(NODE_POLL)
    return lost


def node_resources() -> list[dict[str, float]]:
    """Return the resources of each node on which Ray starts processes, whether used or not: `CPU`, `GPU` and others."""
    return [node["Resources"] for node in usable_nodes()]


def check_nodes(storage: Storage) -> None:
    """Raise ConfigError if the nodes do not share `storage`, or have other versions of this program or of packages."""
    storage.check_reach(node_addresses())
    check_stacks()


def check_stacks() -> None:
    """Raise ConfigError if a node has another version of this program or of a package that affects results."""
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    local_node_id, remote_reads = ray.get_runtime_context().get_node_id(), []
    read = ray.remote(num_cpus=0, max_retries=0)(installed_with_this)
    for node in usable_nodes():
        if node["NodeID"] != local_node_id:
            there = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
            remote_reads.append(
                (node["NodeID"], node["NodeManagerAddress"], read.options(scheduling_strategy=there).remote())
            )
    for node_id, address, ref in remote_reads:
        try:
            remote_stack = ray.get(ref, timeout=NODE_TIMEOUT)
        except ray.exceptions.TaskUnschedulableError:  # it is drained, or has left
            continue
        except ray.exceptions.RayError as error:
            if node_id not in node_ids():
                continue
            raise ConfigError(f"node {address} does not run this program: {one_line(error)}") from error
        check_stack(remote_stack, address)


def check_stack(found: dict[str, str], machine: str) -> None:
    """Raise ConfigError if a machine has other versions than this one. Packages that only one of them has may differ:
    a machine that plays games needs no PyTorch. found: package → version on the machine.
    """
    if (differs := difference(found)) is not None:
        package, theirs, ours = differs
        raise ConfigError(f"machine {machine} has {package} {theirs}, this one has {ours}: {SAME_VERSIONS}")


def check_deployed_stack(deployed: dict[str, str], machine: str) -> None:
    """Raise ConfigError if this machine has other versions than those with which an application was deployed.

    deployed: package → version. machine: the address of this one.
    """
    if (differs := difference(deployed)) is not None:
        package, theirs, ours = differs
        raise ConfigError(
            f"machine {machine} has {package} {ours}, the application was deployed with {theirs}: {SAME_VERSIONS}"
        )


def check_unlimited(local: LocalRay) -> None:
    """Raise ConfigError if `local` has limits, which apply only to a local Ray."""
    if local != UNLIMITED:
        raise ConfigError("--cpus, --object-store and --dashboard are for a local Ray: a cluster has its own")
