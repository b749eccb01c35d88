"""An application on uvicorn with the HTTP protocol of replicas."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

from starlette.types import ASGIApp

from serve_app.runtime.uvicorn_http import HttpProtocol
from tests.support.servers.prompt_uvicorn import Config, Server


@contextmanager
def serving(application: ASGIApp, loop: str) -> Iterator[tuple[str, int]]:
    """The address of a server in a thread that has ended afterwards. loop: uvicorn's name of the event loop."""
    protocol = partial(HttpProtocol, lambda: None, None)
    config = Config(
        application,
        port=0,
        loop=loop,
        http=protocol,  # type: ignore[arg-type]
        timeout_keep_alive=3600,
        lifespan="off",
        log_config=None,
    )
    server = Server(config)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        assert thread.is_alive()
    try:
        yield server.servers[0].sockets[0].getsockname()
    finally:
        server.should_exit = True
        thread.join(20)
    assert not thread.is_alive()
