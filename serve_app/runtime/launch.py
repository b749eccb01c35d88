"""Starts Ray, deploys the application of deploy.yaml, and stops everything without leaving processes behind.

Ray reads its environment variables when it is imported, in every process. Therefore `serve_forever` sets them before it
imports ray, and `running` starts a subprocess, so that it works beside another Ray in the calling process.
"""

import json
import logging
import os
import selectors
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any, NoReturn

import httpx
import yaml
from pydantic import ValidationError

from league import errors
from league.config.validation_errors import describe_validation_error
from league.errors import AlreadyRunning, ConfigError, LeagueError, NotReady, last_line, one_line
from league.interruption import on_ending_signals
from league.ray_cluster import LocalRay, check_stacks, join, node_addresses, ray_session, start_local, usable_cpus
from league.registry.registry import Registry
from league.settings import Storage
from league.subprocesses import Subprocess, when_parent_ends
from serve_app.runtime import haproxy, ray_serve
from serve_app.runtime.autoscaling import LoadPolicy
from serve_app.settings import ServeSettings, is_exposed

OnReady = Callable[[str, Path, str | None], None]
"""Called with the base URL (`http://127.0.0.1:8000`), the directory of Ray's logs on this machine, and the URL of the
dashboard, if there is one."""
DEPLOY_YAML = Path(__file__).parent.parent / "deploy.yaml"
START_TIMEOUT = 300.0
"""Seconds for Ray and the replicas to start."""
OBJECT_STORE = 105
"""Size of Ray's object store in MB; serving hardly uses it."""
STOP_TIMEOUT = 30.0
"""Seconds for a server in a subprocess to stop."""


def serve_forever(
    storage: Storage,
    *,
    host: str | None = None,
    port: int | None = None,
    grpc_port: int | None = None,
    replicas: int | None = None,
    max_replicas: int | None = None,
    insecure: bool = False,
    root_path: str | None = None,
    address: str | None = None,
    dashboard: bool = False,
    deploy: Path = DEPLOY_YAML,
    on_ready: OnReady | None = None,
) -> None:
    """Serve the leagues of `storage` until SIGINT, SIGTERM or SIGHUP, then shut down. Prints nothing.

    SIGHUP stays ignored if it was ignored before, as after `nohup`. Must be called in the main thread of a process that
    has not imported ray.

    Args:
        storage: Leagues to serve.
        host: IPv4 or IPv6 address to listen on, or the name of one; None for that of `deploy`.
        port: HTTP port; None for that of `deploy`.
        grpc_port: gRPC port; None for that of `deploy`.
        replicas: Number of replicas, or the minimum if `max_replicas` is larger; None for that of `deploy`.
        max_replicas: Maximum number of replicas, which then follows the load; None for `replicas`, or that of `deploy`.
        insecure: Accept requests without an API key, even from other machines.
        root_path: The path below which a proxy serves the server; None for that of `deploy`.
        address: A running Ray cluster to serve on, whose nodes have the environment that deploy.yaml lists, as has this
            process. None starts a Ray on the loopback interface.
        dashboard: Whether to start the dashboard of that Ray, and the agents that report to it.
        deploy: The deploy.yaml.
        on_ready: Called once when every replica answers.

    Raises:
        ConfigError: deploy.yaml is invalid, the cluster is unreachable or cannot reach the storage, other machines
            could call the server without a key, or the operating system does not let it listen on a port.
        AlreadyRunning: A port is in use.
        StorageError: The home directory cannot be used.
        NotReady: HAProxy is missing, or the replicas did not start.
    """
    if "ray" in sys.modules:
        raise RuntimeError("serve_forever must set Ray's environment before ray is imported")
    document = load_document(deploy, host, port, grpc_port, replicas, max_replicas, insecure, root_path)
    _check_exposure(document, storage)
    storage.export()
    try:
        with on_ending_signals():
            if address is None:
                _serve_locally(document, dashboard, on_ready)
            else:
                _serve_on_cluster(address, storage, document, on_ready)
    except KeyboardInterrupt:
        return


@contextmanager
def running(
    storage: Storage,
    *,
    host: str = "127.0.0.1",
    port: int = 0,
    grpc_port: int = 0,
    replicas: int | None = None,
    max_replicas: int | None = None,
    insecure: bool = False,
    root_path: str | None = None,
    dashboard: bool = False,
    deploy: Path = DEPLOY_YAML,
    timeout: float = START_TIMEOUT,
) -> Iterator[str]:
    """Serve the leagues of `storage` in a subprocess while the context is active.

    Args:
        storage: Leagues to serve.
        host: Address to listen on.
        port: HTTP port; 0 for a free one.
        grpc_port: gRPC port; 0 for a free one.
        replicas: As for `serve_forever`.
        max_replicas: As for `serve_forever`.
        insecure: Accept requests without an API key.
        root_path: As for `serve_forever`.
        dashboard: As for `serve_forever`.
        deploy: The deploy.yaml.
        timeout: Seconds until every replica must answer.

    Yields:
        The base URL.

    Raises:
        LeagueError: As `serve_forever`.

    All other ports and files are private to the server, so several can run on one machine. It also stops when the
    calling process ends.
    """
    free = haproxy.free_ports(2, host)
    arguments = {
        "host": host,
        "port": port or free[0],
        "grpc_port": grpc_port or free[1],
        "replicas": replicas,
        "max_replicas": max_replicas,
        "insecure": insecure,
        "root_path": root_path,
        "dashboard": dashboard,
    }
    order = json.dumps({"deploy": str(deploy), "arguments": arguments})
    with tempfile.TemporaryFile() as log:
        server = Subprocess("serve_app.runtime.launch", order, storage.environment, output=True, errors=log)
        try:
            yield _await_url(server, log, timeout)
        finally:
            server.terminate(STOP_TIMEOUT)


def load_document(
    deploy: Path,
    host: str | None,
    port: int | None,
    grpc_port: int | None,
    replicas: int | None,
    max_replicas: int | None,
    insecure: bool,
    root_path: str | None = None,
) -> dict[str, Any]:
    """deploy.yaml with the caller's overrides. Raises ConfigError."""
    try:
        document = yaml.safe_load(deploy.read_text(encoding="utf-8"))
        http, (application,) = document["http_options"], document["applications"]
        http |= {"host": host or http["host"], "port": port or http["port"]}
        if grpc_port is not None and "grpc_options" in document:
            document["grpc_options"]["port"] = grpc_port
        _set_replicas(application["deployments"][0], replicas, max_replicas)
        if insecure:
            application["args"] = application.get("args", {}) | {"require_keys": "never"}
        if root_path is not None:
            application["args"] = application.get("args", {}) | {"root_path": root_path}
    except (OSError, yaml.YAMLError, LookupError, TypeError, ValueError) as error:
        reason = one_line(error)
        raise ConfigError(
            f"{deploy}: expected http_options with host and port, and one application: {reason}"
        ) from error
    return document


def _set_replicas(deployment: dict[str, Any], replicas: int | None, max_replicas: int | None) -> None:
    """Set the bounds of the number of replicas, or a fixed number. Raises ConfigError and LookupError."""
    bounds = deployment.get("autoscaling_config")
    if bounds is None:
        if max_replicas is not None:
            raise ConfigError("--max-replicas: deploy.yaml has num_replicas; replace it by autoscaling_config")
        if replicas is not None:
            deployment["num_replicas"] = replicas
        return
    if replicas is not None:
        bounds |= {"min_replicas": replicas, "max_replicas": replicas}
    if max_replicas is not None:
        bounds["max_replicas"] = max_replicas
    lowest, highest = (int(bounds.get(name, 1)) for name in ("min_replicas", "max_replicas"))
    if lowest < 1:
        raise ConfigError(f"deploy.yaml: min_replicas must be at least 1, got {lowest}")
    if highest < lowest:
        raise ConfigError(f"--max-replicas must be at least {lowest}, as --replicas or min_replicas, got {highest}")
    policy = bounds.get("policy", {})
    if policy.get("policy_function") == f"{LoadPolicy.__module__}:{LoadPolicy.__name__}":
        try:
            LoadPolicy(**policy.get("policy_kwargs", {}))  # Ray's controller would fail with a traceback
        except (TypeError, ValueError) as error:
            raise ConfigError(f"deploy.yaml: policy_kwargs: {one_line(error)}") from error


def _omit_statistics(deployment: dict[str, Any]) -> None:
    """Make equal bounds of the number of replicas a fixed number, for which replicas report nothing to Ray."""
    bounds = deployment.get("autoscaling_config")
    if bounds is not None and (number := bounds.get("min_replicas", 1)) == bounds.get("max_replicas", 1):
        del deployment["autoscaling_config"]
        deployment["num_replicas"] = number


def _settings(document: dict[str, Any]) -> ServeSettings:
    """The settings of the replicas. Raises ConfigError."""
    arguments = document["applications"][0].get("args", {})
    try:
        return ServeSettings.model_validate(arguments)
    except ValidationError as error:
        raise ConfigError(f"deploy.yaml: args: {describe_validation_error(error, arguments)}") from error


def _check_exposure(document: dict[str, Any], storage: Storage) -> None:
    """Raise ConfigError if other machines could reach a server without a valid key, which would refuse every request.

    Opens the registry once here, before all replicas open it at the same time.
    """
    with closing(Registry.open(storage)) as registry:
        current_time = datetime.now(UTC)
        has_key = any(key.is_valid(current_time) for key in registry.keys.all())
    host = str(document["http_options"]["host"])
    if is_exposed(host) and not has_key and _settings(document).require_keys != "never":
        raise ConfigError(
            f"other machines can reach {host}, but no API key is valid: run `league keys create NAME --scope act`,"
            " or `league serve --insecure` to accept requests without a key"
        )


def _serve_locally(document: dict[str, Any], dashboard: bool, on_ready: OnReady | None) -> None:
    """Serve on a local Ray."""
    http = document["http_options"]
    host, port = http["host"], http["port"]
    grpc = document.get("grpc_options", {})
    with haproxy.private_directory() as directory:
        for option, requested_port in [("--port", port), *([("--grpc-port", grpc["port"])] if grpc else [])]:
            if not haproxy.is_free(host, requested_port):
                raise AlreadyRunning(
                    f"port {requested_port} of {host} is in use: stop the other server, or choose another with {option}"
                )
        # HAProxy and Ray could choose different addresses of a name.
        _, http["host"] = haproxy.listening_address(host)
        largest = {"RAY_SERVE_GRPC_MAX_MESSAGE_SIZE": str(_settings(document).max_body)}
        for name, value in (haproxy.environment(directory) | largest).items():
            os.environ.setdefault(name, value)
        ray_serve.check_haproxy()
        with ray_session(), _errors_of_ray():
            try:
                has_tasks = _settings(document).evaluation_workers > 1  # those of evaluation.service.evaluation_job
                cpus = max(2, usable_cpus())
                resources = LocalRay(cpus, OBJECT_STORE, dashboard, runtime_envs=has_tasks)
                if not dashboard:
                    _omit_statistics(document["applications"][0]["deployments"][0])
                url = start_local(resources, namespace="serve")
                _deploy(document, on_ready, url)
            finally:
                haproxy.stop(directory)  # before Ray: it stops accepting requests and finishes those in progress


def _serve_on_cluster(address: str, storage: Storage, document: dict[str, Any], on_ready: OnReady | None) -> None:
    """Serve on a running cluster."""
    from ray import serve

    storage.check_no_password("Ray's dashboard")
    (application,) = document["applications"]
    application["runtime_env"] = {"env_vars": storage.environment}
    with ray_session(), _errors_of_ray():
        url = join(address, namespace="serve")
        nodes = node_addresses()
        storage.check_reach(nodes)
        check_stacks()
        if len(nodes) > 1:  # HAProxy of each node calls all replicas
            application["args"] = {"grpc_local_only": False} | application.get("args", {})
        try:
            _deploy(document, on_ready, url)
        finally:
            serve.delete(application["name"])


def _deploy(document: dict[str, Any], on_ready: OnReady | None, dashboard: str | None) -> NoReturn:
    """Deploy, and wait for a signal, which raises KeyboardInterrupt."""
    from ray.serve.schema import ServeDeploySchema

    try:
        schema = ServeDeploySchema.model_validate(document)
    except ValidationError as error:
        raise ConfigError(f"deploy.yaml: {one_line(error)}") from error
    logging.getLogger("ray.serve").setLevel(logging.ERROR)  # this process only: the others log to files
    with on_ending_signals():  # ray.init has replaced the handlers
        ray_serve.deploy(schema)
        host, port = str(schema.http_options.host), schema.http_options.port
        (application,) = schema.applications
        _await_replicas(application.name, application.deployments[0].name, ray_serve.url_here(host, port))
        if on_ready is not None:
            url = ray_serve.url_of(host, port)
            on_ready(url, ray_serve.log_directory(), f"http://{dashboard}" if dashboard else None)
        while True:
            signal.pause()


def _await_replicas(application: str, deployment: str, url: str) -> None:
    """Wait until every replica of a deployment answers through HAProxy. Raises NotReady."""
    from ray import serve

    deadline = time.monotonic() + START_TIMEOUT
    replica_count, answered = 0, set[str]()
    with httpx.Client(timeout=5, trust_env=False) as client:
        while not replica_count or len(answered) < replica_count:
            if time.monotonic() > deadline:
                raise NotReady(f"the replicas did not start within {START_TIMEOUT:g} s")
            status = serve.status().applications.get(application)
            if status is not None and status.status in ("DEPLOY_FAILED", "UNHEALTHY"):
                raise NotReady(f"the replicas did not start: {_reason(status)}")
            if status is not None and status.status == "RUNNING":
                replica_count = status.deployments[deployment].replica_states.get("RUNNING", 0)
                with suppress(httpx.TransportError):
                    response = client.get(f"{url}/v1/health/ready")
                    if response.status_code == 200:
                        answered.add(response.json()["replica"])
            time.sleep(0.05)


def _reason(status: Any) -> str:
    """The last line of the status messages of an application and its deployments."""
    messages = [status.message, *(deployment.message for deployment in status.deployments.values())]
    return last_line("\n".join(messages)) or str(status.status)


@contextmanager
def _errors_of_ray() -> Iterator[None]:
    """Make an error of Ray a NotReady."""
    import ray

    try:
        yield
    except (ray.exceptions.RayError, TimeoutError) as error:
        raise NotReady(f"Ray Serve did not start: {last_line(str(error))}") from error


def _await_url(server: Subprocess, log: IO[bytes], timeout: float) -> str:
    """The base URL that the subprocess prints. Raises the LeagueError that it prints instead."""
    with selectors.DefaultSelector() as selector:
        selector.register(server.stdout, selectors.EVENT_READ)
        if not selector.select(timeout):
            raise NotReady(f"the server did not start within {timeout:g} s")
    line = server.stdout.readline()
    if not line:
        log.seek(0)
        raise NotReady(f"the server process exited during start-up:\n{log.read().decode(errors='replace')[-2000:]}")
    answer = json.loads(line)
    if "url" in answer:
        return str(answer["url"])
    raise getattr(errors, answer["error"], LeagueError)(answer["message"])


def main() -> None:
    """Run `serve_forever` for `running`: print the URL or an error as one line of JSON."""
    order = json.loads(sys.argv[1])
    announce = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # output of Ray goes to the log
    when_parent_ends(lambda: os.kill(os.getpid(), signal.SIGTERM))
    try:
        serve_forever(
            Storage.from_environment(),
            deploy=Path(order["deploy"]),
            on_ready=lambda url, *_: print(json.dumps({"url": url}), file=announce),
            **order["arguments"],
        )
    except LeagueError as error:
        print(json.dumps({"error": type(error).__name__, "message": str(error)}), file=announce)


if __name__ == "__main__":
    main()
