"""The Ray that training runs on: a local one of its own, the caller's, or a cluster."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import ray

from league.errors import ConfigError
from league.settings import Storage


@dataclass(frozen=True, slots=True)
class LocalRay:
    """Limits of a Ray that is started for the run; None for what the machine has.

    object_store: MB of shared memory, from SMALLEST_OBJECT_STORE.
    """

    cpus: int | None = None
    object_store: int | None = None
    dashboard: bool = False


UNLIMITED = LocalRay()
SMALLEST_OBJECT_STORE = 80
"""MB. Ray refuses less than 75 MiB."""


@contextmanager
def connected(address: str | None, storage: Storage, local: LocalRay = UNLIMITED) -> Iterator[str | None]:
    """Have Ray while the block runs; end it afterwards if it was started or joined here. Gives its dashboard's URL.

    address: a cluster to join. None: the Ray that this process is connected to, else a local one within `local`.
    Raises ConfigError if the cluster cannot be reached, or has machines that do not reach `storage`; or if `local`
    limits a Ray that runs already.
    """
    if address is not None:
        check_unlimited(local)
    ours = not ray.is_initialized()
    if ours:
        context = _start(local) if address is None else _join(address)
        url = context.dashboard_url
    else:
        url = None
    try:
        storage.check_reach({node["NodeManagerAddress"] for node in ray.nodes() if node["Alive"]})
        yield f"http://{url}" if url else None
    finally:
        if ours:
            ray.shutdown()


def check_unlimited(local: LocalRay) -> None:
    """Raise ConfigError if `local` has limits, which would be for a Ray of our own."""
    if local != UNLIMITED:
        raise ConfigError("--cpus, --object-store and --dashboard are for a local Ray: a cluster has its own")


def _start(local: LocalRay) -> Any:
    if local.object_store is not None and local.object_store < SMALLEST_OBJECT_STORE:
        raise ConfigError(f"--object-store: at least {SMALLEST_OBJECT_STORE} MB, got {local.object_store}")
    if local.dashboard:
        _check_dashboard()
    return ray.init(
        address="local",
        num_cpus=local.cpus,
        object_store_memory=None if local.object_store is None else local.object_store * 10**6,
        include_dashboard=local.dashboard,
        log_to_driver=False,
        logging_level="ERROR",
    )


def _check_dashboard() -> None:
    try:
        import ray.dashboard.optional_deps
    except ImportError as error:
        raise ConfigError(f"--dashboard needs {error.name}: pip install 'ray[default]=={ray.__version__}'") from error


def _join(address: str) -> Any:
    try:
        return ray.init(address=address, log_to_driver=False, logging_level="ERROR")
    except (ConnectionError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise ConfigError(
            f"no Ray cluster at {address!r}: {reason} (if it asks for a token, as `ray start` does by default: set"
            " RAY_AUTH_MODE=token, and RAY_AUTH_TOKEN on other machines)"
        ) from error
