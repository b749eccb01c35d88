"""Responses of a server while it starts: 503, before Ray and its HAProxy are there to respond.

An HAProxy of its own listens on the server's ports from the first moment. The first HAProxy of Ray that knows a replica
takes over the ports without refusing a connection, as from a stand-in (serve_app.runtime.haproxy_script).
"""

import json
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from serve_app.runtime.haproxy_script import STAND_IN

MESSAGE = "the server is starting: repeat the request"
PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta http-equiv="refresh" content="2"><title>Starting</title></head>
<body><h1>The server is starting</h1><p>This takes about half a minute. The page reloads itself.</p></body></html>
"""
CONFIGURATION = """defaults
    mode http
    timeout connect 5s
    timeout client 10s
    timeout server 10s
    timeout http-request 10s
frontend http_frontend
    bind {host}:{port}
    http-after-response set-header x-content-type-options nosniff
    acl is_page path /
    acl is_page hdr(accept) -m sub text/html
    http-request return status 503 content-type text/html hdr Retry-After 1 file {page} if is_page
    http-request return status 503 content-type application/json hdr Retry-After 1 file {v2} if {{ path_beg /v2/ }}
    http-request return status 503 content-type application/json hdr Retry-After 1 file {v1}
"""
GRPC = """frontend grpc_frontend
    bind {host}:{port} proto h2
    http-request return status 200 content-type application/grpc hdr grpc-status 14 hdr grpc-message "{message}"
"""
"""Status 14 is UNAVAILABLE."""


@contextmanager
def starting_page(directory: Path, binary: str, host: str, port: int, grpc_port: int | None) -> Iterator[None]:
    """Respond with 503 until the HAProxy whose files are in `directory` takes over, at most while the context lasts.

    binary: that of HAProxy. grpc_port: None without gRPC.
    """
    files = {
        "page": PAGE,
        "v1": json.dumps({"code": "not_ready", "message": MESSAGE}),
        "v2": json.dumps({"error": MESSAGE}),
    }
    paths = {name: directory / f"starting.{name}" for name in files}
    for name, text in files.items():
        paths[name].write_text(text)
    configuration = directory / "starting.cfg"
    text = CONFIGURATION.format(host=host, port=port, **paths)
    if grpc_port is not None:
        text += GRPC.format(host=host, port=grpc_port, message=MESSAGE)
    configuration.write_text(text)
    with subprocess.Popen(
        [binary, "-db", "-f", configuration], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as process:
        (directory / STAND_IN).write_text(str(process.pid))
        threading.Thread(target=process.wait, daemon=True).start()  # it ends long before the server, and must be reaped
        try:
            yield
        finally:
            process.kill()
