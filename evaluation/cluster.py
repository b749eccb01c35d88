"""The Ray that matches are played on: a local one that is started for them, the one that is there, or a cluster."""

from __future__ import annotations

import logging
import socket
from collections.abc import Iterator
from contextlib import contextmanager

import ray

from league.errors import ConfigError


@contextmanager
def cluster(address: str | None = None) -> Iterator[None]:
    """Owns the Ray that `start` may start inside the block: it ends with it. A Ray that was there before is left alone.

    address: a cluster to join at once. Raises ConfigError if it cannot be reached.
    """
    owner = not ray.is_initialized()
    if owner and address is not None:
        _join(address)
    try:
        yield
    finally:
        if owner and ray.is_initialized():
            ray.shutdown()


def start(workers: int) -> None:
    """Have Ray: a local one with a CPU for each worker, unless there is one."""
    if not ray.is_initialized():
        ray.init(
            address="local",
            num_cpus=workers,
            include_dashboard=False,
            log_to_driver=False,
            logging_level=logging.ERROR,
        )


def _join(address: str) -> None:
    try:
        _knock(address)
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"no Ray cluster at {address!r}: {' '.join(str(error).split())} (if it asks for a token, as `ray start`"
            " does by default: set RAY_AUTH_MODE=token, and RAY_AUTH_TOKEN on other machines)"
        ) from error


def _knock(address: str) -> None:
    """Raise OSError if nobody listens at HOST:PORT: Ray itself would go on trying for minutes."""
    host, colon, port = address.rpartition(":")
    if colon and port.isdigit() and "/" not in host:
        socket.create_connection((host, int(port)), timeout=10).close()
