"""Environment variables that make Ray Serve answer through HAProxy, and termination of HAProxy's processes.

HAProxy is a child of a Ray worker: if Ray is killed, HAProxy survives and keeps the port. Therefore each server has a
directory of its own that identifies its HAProxy processes, and holds a lock on it while it runs. A process that waits
for the end of the server stops them if the server itself was killed.

Ray generates HAProxy's configuration. No setting of Ray restricts the statistics pages to this machine or limits the
time to send a request, and Ray takes seconds to replace HAProxy after a crash. Therefore Ray starts a wrapper script
(serve_app.runtime.haproxy_script) instead of HAProxy.
"""

import errno
import fcntl
import os
import random
import secrets
import shutil
import signal
import socket
import stat
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from league.errors import ConfigError, NotReady
from league.ray_cluster import usable_cpus
from league.subprocesses import Subprocess
from serve_app.runtime import haproxy_script, worker_start

DIRECTORIES = Path("/tmp")
PREFIX = "league-serve-"
"""Short, because the path of HAProxy's socket is limited to 97 characters, of which Ray adds 57."""
LOCK = "lock"
ALL_INTERFACES = "0.0.0.0"
PORTS = range(25_000, 30_000)
"""Range of free ports: below the kernel's ephemeral ports, and apart from the claimed blocks."""
GRPC_PORT_FILE = "grpc"
"""File with the first gRPC port that a server has claimed."""
GRPC_PORTS = range(10_000, 15_000, 100)
"""First ports of the blocks for the gRPC servers of replicas; a block exceeds the number of replicas of a machine."""
DISTANCE = 10_000
"""From a claimed block to that of the other ports of the same server, which are bound seconds later."""
SOFT_STOP_TIMEOUT = 1.0
"""Seconds for HAProxy to finish requests in progress."""
HARD_STOP_TIMEOUT = 5.0
"""Seconds for killed processes to exit and free their ports."""
CONNECTIONS = 16_384
"""Open connections of clients: the streams of a replica, and others. Those beyond it wait to be accepted. The wrapper
script lowers it to what the file descriptors suffice for."""
IDLE_CLIENT_TIMEOUT = 60
"""Seconds in which a client must send or receive data of a request in progress."""


def environment(directory: Path) -> dict[str, str]:
    """Ray's variables for a server whose HAProxy has its files in `directory`. deploy.yaml explains the first ones."""
    grpc = _claim_grpc_ports(directory)
    proxy_ports = range(grpc.start + DISTANCE, grpc.stop + DISTANCE)
    stats, metrics, fallback_http, fallback_grpc = free_ports(4, ports=proxy_ports)
    binary = haproxy_script.find_haproxy()
    wrapper = {}
    if binary is not None:
        wrapper[haproxy_script.BINARY_PATH] = str(haproxy_script.install(directory, binary, stats, metrics))
    return wrapper | {
        "RAY_SERVE_ENABLE_HA_PROXY": "1",
        "RAY_SERVE_THROUGHPUT_OPTIMIZED": "1",
        "RAY_SERVE_HAPROXY_RETRY_ON": "conn-failure empty-response",
        "RAY_SERVE_HAPROXY_TUNE_BUFSIZE": str(64 * 1024),
        "RAY_SERVE_HAPROXY_MAXCONN": str(CONNECTIONS),
        "RAY_SERVE_HAPROXY_NBTHREAD": str(usable_cpus()),
        "RAY_SERVE_HAPROXY_METRICS_ENABLED": "0",
        "RAY_SERVE_HAPROXY_TIMEOUT_SERVER_S": "5",
        "RAY_SERVE_HAPROXY_TIMEOUT_CLIENT_S": str(IDLE_CLIENT_TIMEOUT),
        # Seconds between health checks of HAProxy; it is replaced after three failures.
        "RAY_SERVE_PROXY_HEALTH_CHECK_PERIOD_S": "1",
        # Ray ends a proxy that three times in a row is not ready within this time. On a busy machine the start takes
        # longer than three times Ray's default of 5 s, and would never succeed.
        "RAY_SERVE_PROXY_READY_CHECK_TIMEOUT_S": "30",
        "RAY_SERVE_HTTP_PROXY_CALLBACK_IMPORT_PATH": "serve_app.runtime.serve_bypass:middlewares",
        # Seconds between turns of Ray Serve's controller. With the default, 0.1, they and their requests to the GCS
        # take two fifths of an idle server's processor time. Promotions and failovers do not depend on them.
        "RAY_SERVE_CONTROL_LOOP_INTERVAL_S": "0.5",
        # Ray starts its workers with 15: any busy process of the machine would take the CPU from the replicas.
        "RAY_worker_niceness": "0",
        worker_start.WORKER_HOOK: f"{worker_start.__name__}.{worker_start.prepare.__name__}",
        "RAY_AUTH_MODE": "token",
        # Inference in a replica uses one thread.
        "OMP_NUM_THREADS": "1",
        # Otherwise each thread keeps buffers of messages of megabytes for the next ones.
        "MALLOC_MMAP_THRESHOLD_": "262144",
        # Fixed by default, which would conflict with another server on this machine.
        "RAY_SERVE_HAPROXY_STATS_PORT": str(stats),
        "RAY_SERVE_HAPROXY_METRICS_PORT": str(metrics),
        "RAY_SERVE_FALLBACK_PROXY_HTTP_PORT": str(fallback_http),
        "RAY_SERVE_FALLBACK_PROXY_GRPC_PORT": str(fallback_grpc),
        # Ray disables port sharing of its gRPC servers by an option of the wrong type, which gRPC ignores: two servers
        # on one machine would share ports and answer each other's calls.
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
    """A directory for the HAProxy of one server. On exit its processes are stopped and it is removed.

    A subprocess does so if this process is killed. Directories of servers whose subprocess was killed too are cleaned
    up first.
    """
    for abandoned in _own_directories():
        with suppress(OSError), _locked(abandoned) as is_abandoned:
            if is_abandoned:
                _remove(abandoned)
    name = PREFIX + secrets.token_hex(4)
    directory, unlocked = DIRECTORIES / name, DIRECTORIES / f".{name}"
    unlocked.mkdir(mode=0o700)
    (unlocked / LOCK).touch()
    with _locked(unlocked):
        unlocked.rename(directory)  # visible to other servers only after it is locked
        cleaner = Subprocess(__name__, str(directory))
        try:
            yield directory
        finally:
            _remove(directory)
            cleaner.stop()


def free_ports(count: int, host: str = ALL_INTERFACES, ports: range = PORTS) -> list[int]:
    """Unused ports of `host`. Raises ConfigError as `is_free`, and NotReady if there are fewer."""
    unused_ports = []
    for port in random.sample(ports, len(ports)):
        if is_free(host, port):
            unused_ports.append(port)
        if len(unused_ports) == count:
            return unused_ports
    raise NotReady(f"found fewer than {count} free ports from {ports.start} to {ports.stop - 1}")


def _own_directories() -> list[Path]:
    """The directories of this user's servers. Those of others are not opened: they may contain pipes or links."""
    directories = []
    for path in DIRECTORIES.glob(f"{PREFIX}*"):
        with suppress(OSError):  # removed in the meantime
            status = path.lstat()
            if stat.S_ISDIR(status.st_mode) and status.st_uid == os.geteuid():
                directories.append(path)
    return directories


def _claim_grpc_ports(directory: Path) -> range:
    """Claim a block of unused ports for the gRPC servers of replicas."""
    claims = (own_directory / GRPC_PORT_FILE for own_directory in _own_directories())
    claimed_starts = {int(claim.read_text()) for claim in claims if claim.exists()}
    for start in random.sample(GRPC_PORTS, len(GRPC_PORTS)):
        block = range(start, start + GRPC_PORTS.step)
        if start not in claimed_starts and all(is_free(ALL_INTERFACES, port) for port in block):
            (directory / GRPC_PORT_FILE).write_text(str(start))
            return block
    raise NotReady(f"found no block of {GRPC_PORTS.step} free ports from {GRPC_PORTS.start}")


def listening_address(host: str) -> tuple[socket.AddressFamily, str]:
    """The address on which a server listens, and its family. A name stands for its IPv4 address, if it has one.

    Raises ConfigError if the host is neither an address nor a known name.
    """
    try:
        addresses = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a host name"
        raise ConfigError(
            f"cannot listen on {host}: {reason}; expected an address or a name of this machine"
        ) from error
    family, *_, address = min(addresses, key=lambda entry: entry[0] != socket.AF_INET)
    return family, str(address[0])


def is_free(host: str, port: int) -> bool:
    """Whether no other server uses a port.

    Raises ConfigError, with the reason of the operating system, if no server of this user can listen on it.
    """
    if not 0 < port < 2**16:
        raise ConfigError(f"a port must be from 1 to 65535, got {port}")
    family, address = listening_address(host)
    try:
        with socket.socket(family) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((address, port))
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            return False
        raise ConfigError(f"cannot listen on port {port} of {host}: {error.strerror}") from error
    return True


def stop(directory: Path) -> None:
    """Stop the HAProxy processes of a directory: gracefully, then by force."""
    with suppress(OSError):
        (directory / haproxy_script.STOPPED).touch()
    for number, seconds in ((signal.SIGUSR1, SOFT_STOP_TIMEOUT), (signal.SIGKILL, HARD_STOP_TIMEOUT)):
        for pid in processes(directory):
            with suppress(ProcessLookupError):
                os.kill(pid, number)
        deadline = time.monotonic() + seconds
        while processes(directory) and time.monotonic() < deadline:
            time.sleep(0.02)


def processes(directory: Path) -> list[int]:
    """The HAProxy processes whose configuration is in a directory."""
    process_ids = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        with suppress(OSError):
            arguments = (entry / "cmdline").read_bytes().split(b"\0")
            if b"haproxy" in arguments[0] and any(a.startswith(os.fsencode(directory)) for a in arguments):
                process_ids.append(int(entry.name))
    return process_ids


def _remove(directory: Path) -> None:
    stop(directory)
    shutil.rmtree(directory, ignore_errors=True)


@contextmanager
def _locked(directory: Path) -> Iterator[bool]:
    """Hold a directory's lock, which is released when the process ends. Yields False if another process holds it."""
    with (directory / LOCK).open() as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
            return
        yield True


def main() -> None:
    """Wait until the server whose directory is the argument has ended, and remove what it has left."""
    sys.stdin.buffer.read()
    _remove(Path(sys.argv[1]))


if __name__ == "__main__":
    main()
