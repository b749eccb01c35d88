"""A reverse proxy in front of a server: HAProxy, which can be frozen, stopped and started again."""

import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from serve_app.runtime import haproxy, haproxy_script
from tests.support.waiting import until

CONFIGURATION = """defaults
    mode http
    timeout connect 5s
    timeout client 60s
    timeout server 60s
    timeout tunnel 60s
frontend proxy
    bind 127.0.0.1:{port}
    http-request return status 404 unless {{ path_beg {prefix}/ }}
    {rewrite}
    default_backend server
backend server
    server one {authority}
"""


@dataclass
class Proxy:
    """A proxy that serves a server below `prefix`."""

    configuration: Path
    port: int
    prefix: str
    _processes: list["subprocess.Popen[bytes]"] = field(default_factory=list)

    @property
    def url(self) -> str:
        """The URL of the server behind the proxy."""
        return f"http://127.0.0.1:{self.port}{self.prefix}"

    def start(self) -> None:
        """Start, and wait until the proxy listens."""
        binary = haproxy_script.find_haproxy()
        assert binary is not None
        self._processes.append(subprocess.Popen([binary, "-db", "-f", str(self.configuration)]))
        until(lambda: not haproxy.is_free("127.0.0.1", self.port))

    def freeze(self) -> None:
        """Stop sending and receiving. Connections stay open."""
        self._processes[-1].send_signal(signal.SIGSTOP)

    def thaw(self) -> None:
        """Continue."""
        self._processes[-1].send_signal(signal.SIGCONT)

    def stop(self) -> None:
        """End all connections, and refuse others."""
        process = self._processes.pop()
        process.kill()
        process.wait()


@contextmanager
def proxy(directory: Path, server: str, prefix: str = "", *, strips: bool = True) -> Iterator[Proxy]:
    """Run a proxy for the server at the URL `server`.

    strips: whether the proxy removes the prefix from the paths of requests.
    """
    (port,) = haproxy.free_ports(1, "127.0.0.1")
    configuration = directory / "proxy.cfg"
    rewrite = f"http-request replace-path {prefix}(/.*) \\1" if strips else ""
    authority = server.removeprefix("http://")
    configuration.write_text(CONFIGURATION.format(port=port, prefix=prefix, rewrite=rewrite, authority=authority))
    running = Proxy(configuration, port, prefix)
    running.start()
    try:
        yield running
    finally:
        if running._processes:
            running.stop()
