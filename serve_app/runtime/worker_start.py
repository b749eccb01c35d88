"""What each worker of a local server does first. Imports little, because the workers include Ray's own."""

import sys

from serve_app.runtime.grpc_servers import listen_on_loopback

WORKER_HOOK = "__RAY_WORKER_PROCESS_SETUP_HOOK_ENV_VAR"
"""Ray's environment variable for a function that each process of a worker calls first, by its import path."""


def import_serve() -> None:
    """Import Ray Serve without pandas, which it only needs to encode data frames in responses.

    pandas and PyArrow would take a third of the memory of each process, and as much of its start.
    """
    is_missing = "pandas" not in sys.modules
    if is_missing:
        sys.modules["pandas"] = None  # type: ignore[assignment]  # Serve handles the ImportError
    try:
        import ray.serve  # noqa: F401
    finally:
        if is_missing:
            del sys.modules["pandas"]


def prepare() -> None:
    """Called by Ray: the WORKER_HOOK."""
    import_serve()
    listen_on_loopback()
