"""One replica in a process of its own, without Ray but with its event loop and protocols, whose clock may be wrong.

`python -m benchmarks.registry.standalone_replica NAME HOME DATABASE_URL ARTIFACTS [--hours 1]` prints its port as
soon as it is ready. Its log is the standard error.
"""

import argparse
import asyncio
import datetime
import sys
import time
from pathlib import Path
from typing import Any


def main() -> None:
    """Serve until the process is ended."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name")
    parser.add_argument("home", type=Path)
    parser.add_argument("database_url")
    parser.add_argument("artifacts", type=Path)
    parser.add_argument("--hours", type=float, default=0.0, help="how far the clock is ahead")
    options = parser.parse_args()
    import uvloop

    uvloop.run(_serve(options))


def _set_clock(hours: float) -> None:
    """Change the clock as the modules of the product see it."""
    real, real_time = datetime.datetime, time.time

    class Clock(real):
        @classmethod
        def now(cls, tz: datetime.tzinfo | None = None) -> datetime.datetime:  # type: ignore[override]
            return real.now(tz) + datetime.timedelta(hours=hours)

    for name, module in list(sys.modules.items()):
        if name.partition(".")[0] in ("league", "serve_app"):
            for attribute, value in (("datetime", Clock), ("time", lambda: real_time() + 3600 * hours)):
                if getattr(module, attribute, None) in (real, real_time):
                    setattr(module, attribute, value)


async def _serve(options: argparse.Namespace) -> None:
    import uvicorn

    from league.registry.registry import Registry
    from league.settings import Storage
    from serve_app.app import Replica
    from serve_app.runtime import uvicorn_http, uvicorn_websocket
    from serve_app.settings import ServeSettings

    if options.hours:
        _set_clock(options.hours)
    registry = Registry.open(Storage(options.home, options.database_url, options.artifacts), create=False)
    settings = ServeSettings()
    replica = Replica(registry, settings, options.name)
    application = replica.application()
    uvicorn_http.install(replica.events.end)
    uvicorn_websocket.install(settings.max_body, settings.max_incomplete)
    server = uvicorn.Server(uvicorn.Config(application, host="127.0.0.1", port=0, log_level="error"))
    serving = asyncio.create_task(server.serve())
    while not server.started:
        await asyncio.sleep(0.01)
        if serving.done():
            sys.exit("the replica did not start")
    listener: Any = server.servers[0].sockets[0]
    print(listener.getsockname()[1], flush=True)
    await serving


if __name__ == "__main__":
    main()
