"""The Ray that training runs on: a local one of its own, the caller's, or a cluster."""

from collections.abc import Iterator
from contextlib import contextmanager

import ray

from league.errors import ConfigError
from league.settings import Storage


@contextmanager
def connected(address: str | None, storage: Storage) -> Iterator[None]:
    """Have Ray while the block runs; end it afterwards if it was started or joined here.

    address: a cluster to join. None: the Ray that this process is connected to, else a local one.
    Raises ConfigError if the cluster cannot be reached, or has machines that do not reach `storage`.
    """
    ours = not ray.is_initialized()
    if ours:
        _connect(address)
    try:
        storage.check_reach({node["NodeManagerAddress"] for node in ray.nodes() if node["Alive"]})
        yield
    finally:
        if ours:
            ray.shutdown()


def _connect(address: str | None) -> None:
    if address is None:
        ray.init(address="local", include_dashboard=False, log_to_driver=False, logging_level="ERROR")
        return
    try:
        ray.init(address=address, log_to_driver=False, logging_level="ERROR")
    except (ConnectionError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise ConfigError(
            f"no Ray cluster at {address!r}: {reason} (if it asks for a token, as `ray start` does by default: set"
            " RAY_AUTH_MODE=token, and RAY_AUTH_TOKEN on other machines)"
        ) from error
