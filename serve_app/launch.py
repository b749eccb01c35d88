"""Start Ray, deploy the application of deploy.yaml, and stop it again without leaving a process behind.

Ray reads its environment variables when it is imported, in every process. `serve_forever` therefore sets them before
it imports ray, and `running` starts a process of its own, so that it works beside another Ray in the caller's process.
"""

import json
import logging
import os
import selectors
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any, NoReturn

import httpx
import yaml
from pydantic import ValidationError

from league import errors
from league.errors import AlreadyRunning, ConfigError, LeagueError, NotReady
from league.registry.registry import Registry
from league.settings import Storage
from serve_app import haproxy
from serve_app.exposure import is_exposed
from serve_app.settings import ServeSettings

DEPLOY_YAML = Path(__file__).resolve().parent.parent / "deploy.yaml"
START = 180.0
"""Seconds that Ray and the replicas have to start."""
STOP = 30.0
"""Seconds that a server in a process of its own has to stop."""


def serve_forever(
    storage: Storage,
    *,
    host: str | None = None,
    port: int | None = None,
    grpc_port: int | None = None,
    replicas: int | None = None,
    insecure: bool = False,
    address: str | None = None,
    deploy: Path = DEPLOY_YAML,
    on_ready: Callable[[str], None] | None = None,
) -> None:
    """Serve the leagues of `storage` until SIGINT or SIGTERM, then shut everything down.

    `host`, `port`, `grpc_port` and `replicas` override what `deploy` says. `address` is a running Ray cluster to serve
    on, whose nodes have the environment that deploy.yaml lists, as this process has; by default a Ray of its own is
    started on the loopback interface. `insecure` lets requests do without an API key, whoever can reach the server.
    `on_ready` is called once with the base URL (`http://127.0.0.1:8000`) when every replica answers. Nothing is printed
    here.

    Must be called in the main thread of a process that has not imported ray.

    Raises ConfigError (deploy.yaml; a cluster that cannot reach the storage; other machines could call without a key),
    AlreadyRunning (a port is taken), StorageError (the home cannot be used), NotReady (HAProxy is missing, or the
    replicas did not start).
    """
    if "ray" in sys.modules:
        raise RuntimeError("serve_forever must set Ray's environment before ray is imported")
    document = _document(deploy, host, port, grpc_port, replicas, insecure)
    _refuse_strangers(document, storage)
    storage.export()
    try:
        with _interruptible():
            if address is None:
                _serve_here(document, on_ready)
            else:
                _serve_on(address, storage, document, on_ready)
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
    insecure: bool = False,
    deploy: Path = DEPLOY_YAML,
    timeout: float = START,
) -> Iterator[str]:
    """Serve the leagues of `storage` in a process of its own while the context lasts; yields the base URL.

    `port` and `grpc_port` 0 take free ones. Every port and file that HAProxy needs besides is private to this server,
    so that several may run on one machine. `timeout` is in seconds, until every replica answers. The server also stops
    when the caller's process dies.

    Raises what `serve_forever` raises.
    """
    free = haproxy.free_ports(2, host)
    order = _Order(
        home=str(storage.home),
        database_url=storage.database_url,
        artifacts=str(storage.artifacts),
        host=host,
        port=port or free[0],
        grpc_port=grpc_port or free[1],
        replicas=replicas,
        insecure=insecure,
        deploy=str(deploy),
    )
    command = [sys.executable, "-m", "serve_app.launch", json.dumps(asdict(order))]
    with (
        tempfile.TemporaryFile() as log,
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log) as server,
    ):
        try:
            yield _await_url(server, log, timeout)
        finally:
            _stop(server)


@dataclass(frozen=True, slots=True)
class _Order:
    """What `running` tells its process."""

    home: str
    database_url: str
    artifacts: str
    host: str
    port: int
    grpc_port: int
    replicas: int | None
    insecure: bool
    deploy: str


def _document(
    deploy: Path, host: str | None, port: int | None, grpc_port: int | None, replicas: int | None, insecure: bool
) -> dict[str, Any]:
    """deploy.yaml with the caller's overrides. Raises ConfigError."""
    try:
        document = yaml.safe_load(deploy.read_text(encoding="utf-8"))
        http, (application,) = document["http_options"], document["applications"]
        http |= {"host": host or http["host"], "port": port or http["port"]}
        if grpc_port is not None and "grpc_options" in document:
            document["grpc_options"]["port"] = grpc_port
        if replicas is not None:
            application["deployments"][0]["num_replicas"] = replicas
        if insecure:
            application["args"] = application.get("args", {}) | {"require_keys": "never"}
    except (OSError, yaml.YAMLError, LookupError, TypeError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise ConfigError(
            f"{deploy}: expected http_options with host and port, and one application: {reason}"
        ) from error
    return document


def _settings(document: dict[str, Any]) -> ServeSettings:
    """What the replicas will be told. Raises ConfigError."""
    try:
        return ServeSettings.model_validate(document["applications"][0].get("args", {}))
    except ValidationError as error:
        raise ConfigError(f"deploy.yaml: args: {' '.join(str(error).split())}") from error


def _refuse_strangers(document: dict[str, Any], storage: Storage) -> None:
    """Raise ConfigError if other machines could reach a server that has nobody's key.

    Such replicas would refuse every request: this says why beforehand. Opens the registry, once here, rather than all
    replicas at the same time.
    """
    registry = Registry.open(storage)
    try:
        now = datetime.now(UTC)
        has_key = any(key.is_valid(now) for key in registry.api_keys())
    finally:
        registry.close()
    host = str(document["http_options"]["host"])
    if is_exposed(host) and not has_key and _settings(document).require_keys != "never":
        raise ConfigError(
            f"other machines can reach {host}, and no API key is valid: `league keys create NAME --scope act`,"
            " or `league serve --insecure` to let everybody in"
        )


def _serve_here(document: dict[str, Any], on_ready: Callable[[str], None] | None) -> None:
    """Serve on a Ray of our own."""
    host, port = document["http_options"]["host"], document["http_options"]["port"]
    grpc = document.get("grpc_options", {})
    with haproxy.private_directory() as directory:
        for wanted in (port, grpc["port"]) if grpc else (port,):
            if not haproxy.is_free(host, wanted):
                raise AlreadyRunning(f"port {wanted} of {host} is taken: another server runs there")
        largest = {"RAY_SERVE_GRPC_MAX_MESSAGE_SIZE": str(_settings(document).max_body)}
        for name, value in (haproxy.environment(directory) | largest).items():
            os.environ.setdefault(name, value)
        haproxy.require_binary()
        import ray

        try:
            ray.init(
                address="local",
                num_cpus=max(2, os.cpu_count() or 2),
                object_store_memory=100 * 2**20,
                include_dashboard=False,
                namespace="serve",
                log_to_driver=False,
                logging_level=logging.ERROR,
                _node_ip_address="127.0.0.1",
            )
            _deploy(document, on_ready)
        except ray.exceptions.RayError as error:
            raise NotReady(f"Ray Serve did not start: {_last_line(str(error))}") from error
        finally:
            # HAProxy first: it stops taking requests and finishes those in progress.
            haproxy.stop(directory)
            ray.shutdown()


def _serve_on(address: str, storage: Storage, document: dict[str, Any], on_ready: Callable[[str], None] | None) -> None:
    """Serve on a running cluster."""
    import ray
    from ray import serve

    where = ("LEAGUE_HOME", "LEAGUE_DATABASE_URL", "LEAGUE_ARTIFACTS")
    (application,) = document["applications"]
    application["runtime_env"] = {"env_vars": {name: os.environ[name] for name in where}}
    try:
        ray.init(address=address, namespace="serve", log_to_driver=False, logging_level=logging.ERROR)
    except ConnectionError as error:
        raise NotReady(f"Ray at {address} cannot be reached: {_last_line(str(error.__cause__ or error))}") from error
    try:
        nodes = {node["NodeManagerAddress"] for node in ray.nodes() if node["Alive"]}
        storage.check_reach(nodes)
        if len(nodes) > 1:  # the HAProxies of all nodes call every replica
            application["args"] = {"grpc_local_only": False} | application.get("args", {})
        try:
            _deploy(document, on_ready)
        finally:
            serve.delete(application["name"])
    finally:
        ray.shutdown()


def _deploy(document: dict[str, Any], on_ready: Callable[[str], None] | None) -> NoReturn:
    """Deploy and wait for a signal, which raises KeyboardInterrupt."""
    from ray.serve._private.api import serve_start
    from ray.serve.schema import ServeDeploySchema

    try:
        schema = ServeDeploySchema.model_validate(document)
    except ValidationError as error:
        raise ConfigError(f"deploy.yaml: {' '.join(str(error).split())}") from error
    logging.getLogger("ray.serve").setLevel(logging.ERROR)  # of this process: the others have their files
    _interrupt_on_signals()  # ray.init has put its own handlers in place
    client = serve_start(
        http_options=schema.http_options.model_dump(),
        grpc_options=schema.grpc_options.model_dump(),
        proxy_location=schema.proxy_location,
    )
    client.deploy_apps(schema, _blocking=False)
    url = f"http://{schema.http_options.host}:{schema.http_options.port}"
    (application,) = schema.applications
    _await_replicas(application.name, application.deployments[0].name, url.replace("0.0.0.0", "127.0.0.1"))
    if on_ready is not None:
        on_ready(url)
    while True:
        signal.pause()


def _await_replicas(application: str, deployment: str, url: str) -> None:
    """Return when every replica of a deployment answers through HAProxy. Raises NotReady."""
    from ray import serve

    deadline = time.monotonic() + START
    wanted, answered = 0, set[str]()
    with httpx.Client(timeout=5, trust_env=False) as client:
        while not wanted or len(answered) < wanted:
            if time.monotonic() > deadline:
                raise NotReady(f"the replicas did not start within {START:g} s")
            status = serve.status().applications.get(application)
            if status is not None and status.status in ("DEPLOY_FAILED", "UNHEALTHY"):
                raise NotReady(f"the replicas did not start: {_reason(status)}")
            if status is not None and status.status == "RUNNING":
                wanted = status.deployments[deployment].replica_states.get("RUNNING", 0)
                answered |= _replica_that_answers(client, url)
            time.sleep(0.05)


def _replica_that_answers(client: httpx.Client, url: str) -> set[str]:
    try:
        reply = client.get(f"{url}/v1/health/ready")
    except httpx.TransportError:
        return set()
    return {reply.json()["replica"]} if reply.status_code == 200 else set()


def _reason(status: Any) -> str:
    """The last line of what Serve says of an application and its deployments."""
    told = [status.message, *(deployment.message for deployment in status.deployments.values())]
    return _last_line("\n".join(told)) or str(status.status)


def _last_line(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else ""


@contextmanager
def _interruptible() -> Iterator[None]:
    """SIGTERM does here what Ctrl-C does; afterwards the signals have their former handlers again."""
    former = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    _interrupt_on_signals()
    try:
        yield
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)


def _interrupt_on_signals() -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)


def _await_url(server: subprocess.Popen[bytes], log: IO[bytes], timeout: float) -> str:
    """The base URL that the server's process announces. Raises the LeagueError that it announces instead."""
    assert server.stdout is not None
    with selectors.DefaultSelector() as selector:
        selector.register(server.stdout, selectors.EVENT_READ)
        if not selector.select(timeout):
            raise NotReady(f"the server did not start within {timeout:g} s")
    line = server.stdout.readline()
    if not line:
        log.seek(0)
        raise NotReady(f"the server died while it started:\n{log.read().decode(errors='replace')[-2000:]}")
    told = json.loads(line)
    if "url" in told:
        return str(told["url"])
    raise getattr(errors, told["error"], LeagueError)(told["message"])


def _stop(server: subprocess.Popen[bytes]) -> None:
    server.terminate()
    try:
        server.wait(STOP)
    except subprocess.TimeoutExpired:
        server.kill()


def _stop_with_parent() -> None:
    """End this process when the one that started it is gone, which closes our standard input."""

    def watch() -> None:
        while sys.stdin.buffer.read(1024):
            pass
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()


def main() -> None:
    """Carry out the order of `running`: announce the URL or an error in one line of JSON."""
    order = _Order(**json.loads(sys.argv[1]))
    announce = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # whatever Ray prints goes to the log
    _stop_with_parent()
    try:
        serve_forever(
            Storage(Path(order.home), order.database_url, Path(order.artifacts)),
            host=order.host,
            port=order.port,
            grpc_port=order.grpc_port,
            replicas=order.replicas,
            insecure=order.insecure,
            deploy=Path(order.deploy),
            on_ready=lambda url: print(json.dumps({"url": url}), file=announce),
        )
    except LeagueError as error:
        print(json.dumps({"error": type(error).__name__, "message": str(error)}), file=announce)


if __name__ == "__main__":
    main()
