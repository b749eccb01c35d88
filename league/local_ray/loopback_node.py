"""The node of a local Ray, which `ray.init` creates.

Ray's own node would listen on all interfaces, and give up 30 s after it has started its processes. Its raylet would end
after half of that time unless the agents that it starts, which import for seconds, have written down their ports. Here
the ports are given, so that the raylet does not wait for them, and the node waits as long as its processes live.

It starts no processes for what a local Ray does not use: the dashboard, an autoscaler, runtime environments (workers
inherit the environment of the driver), and a driver that prints the output of workers. Together they would take 4 s of
processor time at the start, and 300 MB.
"""

from __future__ import annotations

import random
import socket
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from typing import TYPE_CHECKING, Any

from rich.console import Console

from league.errors import NotReady

if TYPE_CHECKING:
    from ray._private.node import Node

ADDRESS = "127.0.0.1"
"""Ray binds all ports of a node with this address to the loopback interface."""
PORTS = range(31_000, 32_768)
"""Range of the agents' ports: below the kernel's ephemeral ports, above those of a server's replicas."""
AGENT_PORTS = ("metrics_agent_port", "metrics_export_port", "dashboard_agent_listen_port", "runtime_env_agent_port")
"""Ray's names of the ports for whose choice its raylet would wait."""
WAIT = 'sh -c "exec cat"'
"""Command of an agent that only waits for the end of the raylet, which holds the other end of its pipe."""
PATIENCE = 600
"""Seconds for the steps of a start whose progress cannot be observed."""
LIMITS = {
    "RAY_gcs_server_port_wait_time_s": str(PATIENCE),  # until the GCS listens
    "RAY_agent_register_timeout_ms": str(1000 * PATIENCE),  # until the raylet reaches its agents, or else ends
    "RAY_worker_register_timeout_seconds": str(PATIENCE),  # until a worker has started, or else is replaced
}
"""Ray's environment variables for limits of a start, whose defaults are 30, 30 and 60 s."""
WAITING_WORKERS = {
    "RAY_isolate_workers_across_task_types": "0",
    "RAY_idle_worker_killing_time_threshold_ms": "120000",  # instead of 1000, once the CPUs are reserved
}
"""Ray's environment variables that let the workers which start with the node become actors later."""
WITHOUT_AGENTS = {
    "RAY_enable_pipe_based_agent_to_parent_health_check": "1",  # the raylet gives its agents a pipe
    "RAY_enable_metrics_collection": "0",
    "RAY_task_events_report_interval_ms": "0",  # never: only the dashboard shows them
}
"""Ray's environment variables for a node without agents."""
POLL = 0.1
"""Seconds between two looks at a node that starts."""
NOTICE = 10.0
"""Seconds between two lines that say what is waited for."""


class StartFailed(Exception):
    """A process of the node ended while it started."""


@contextmanager
def loopback_node(runtime_envs: bool = False) -> Iterator[None]:
    """Let `ray.init` start its node on the loopback interface, and wait for it.

    runtime_envs: whether tasks may have runtime environments.
    """
    from ray._private import node

    original = node.Node
    node.Node = _node_class(original, runtime_envs)
    try:
        yield
    finally:
        node.Node = original


@contextmanager
def loopback_addresses() -> Iterator[None]:
    """Let `ray.init` connect to loopback addresses as they are. Ray would replace them by that of the machine."""
    from ray._private import ray_constants

    original = ray_constants.ENABLE_RAY_CLUSTER
    ray_constants.ENABLE_RAY_CLUSTER = False  # read only where an address is replaced
    try:
        yield
    finally:
        ray_constants.ENABLE_RAY_CLUSTER = original


def is_own() -> bool:
    """Return whether this process has started the Ray that it is connected to."""
    from ray._private.worker import _global_node

    return _global_node is not None and _global_node.is_head()


def _node_class(base: Any, runtime_envs: bool) -> Any:
    class LoopbackNode(base):
        def __init__(self, ray_params: Any, *arguments: Any, **options: Any) -> None:
            ray_params.node_ip_address = ADDRESS
            ray_params.no_monitor, ray_params.include_log_monitor = True, False
            for name, port in zip(AGENT_PORTS, free_ports(len(AGENT_PORTS)), strict=True):
                setattr(ray_params, name, port)
            super().__init__(ray_params, *arguments, **options)

        def start_api_server(self, *, include_dashboard: bool | None, raise_on_failure: bool) -> None:
            if include_dashboard:
                super().start_api_server(include_dashboard=True, raise_on_failure=raise_on_failure)

        def start_raylet(self, *arguments: Any, **options: Any) -> None:
            unused = {"dashboard": not self._ray_params.include_dashboard, "runtime_env": not runtime_envs}
            with _without_agents([name for name, is_unused in unused.items() if is_unused]):
                super().start_raylet(*arguments, **options)

        def start_ray_processes(self) -> None:
            raylet: Any = import_module("ray._raylet")
            # The only one of these ports that is not among the arguments of the raylet.
            name, port = raylet.DASHBOARD_AGENT_LISTEN_PORT_NAME, self._ray_params.dashboard_agent_listen_port
            raylet.persist_port(self._session_dir, self._node_id, name, port)
            super().start_ray_processes()
            try:
                _await_registration(self)
            except BaseException:
                self.kill_all_processes(check_alive=False, wait=True)
                raise

    return LoopbackNode


@contextmanager
def _without_agents(names: Sequence[str]) -> Iterator[None]:
    """Let Ray's raylet start WAIT instead of some of its agents. It requires both, and ends with them."""
    from ray._private import services

    original = services.start_ray_process
    agents = tuple(f"--{name}_agent_command=" for name in names)

    def start(command: list[str], *arguments: Any, **options: Any) -> Any:
        changed = [a.partition("=")[0] + f"={WAIT}" if agents and a.startswith(agents) else a for a in command]
        return original(changed, *arguments, **options)

    services.start_ray_process = start
    try:
        yield
    finally:
        services.start_ray_process = original


def _await_registration(node: Node) -> None:
    """Wait until the raylet has registered. Raises StartFailed if a process ends before."""
    from ray.exceptions import RpcError

    start_time = noticed = time.monotonic()
    while True:
        with suppress(RpcError):  # the GCS did not answer in time
            if node.get_gcs_client().get_all_node_info(timeout=NOTICE):
                return
        for name, processes in node.all_processes.items():
            if any(info.process.poll() is not None for info in processes):
                raise StartFailed(f"its process {name} ended; see {node.get_logs_dir_path()}")
        if (current_time := time.monotonic()) - noticed >= NOTICE:
            noticed = current_time
            say(f"Waiting for Ray to start: its raylet has not registered after {current_time - start_time:.0f} s")
        time.sleep(POLL)


def say(line: str) -> None:
    """Print a line for the person who waits, on standard error."""
    Console(stderr=True, highlight=False).print(line, style="dim", soft_wrap=True)


def free_ports(count: int) -> list[int]:
    """Unused ports of the loopback interface. Raises NotReady."""
    ports: list[int] = []
    for port in random.sample(PORTS, len(PORTS)):
        with socket.socket() as probe:
            try:
                probe.bind((ADDRESS, port))
            except OSError:
                continue
        ports.append(port)
        if len(ports) == count:
            return ports
    raise NotReady(f"found fewer than {count} free ports from {PORTS.start} to {PORTS.stop - 1}")
