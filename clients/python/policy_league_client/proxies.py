"""Proxies that environment variables name: never used for this machine, and named in errors."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from urllib.request import proxy_bypass

import httpx

from policy_league_client.errors import InvalidInput, one_line
from policy_league_client.loopback import is_loopback


def through_proxy(url: str) -> str:
    """Return ` through the proxy of VARIABLE`, for a message, if a proxy passes on requests to a URL; else nothing."""
    parts = httpx.URL(url)
    if is_loopback(parts.host) or proxy_bypass(parts.host):
        return ""
    return next((f" through the proxy of {name}" for name in variables(parts.scheme, "all")), "")


@contextmanager
def usable_proxies() -> Iterator[None]:
    """Turn the error of a connection whose proxy has an unsupported or invalid URL into InvalidInput."""
    try:
        yield
    except (ImportError, ValueError, httpx.InvalidURL) as error:
        if not (names := " or ".join(variables("http", "https", "all"))):
            raise
        raise InvalidInput(f"the proxy that {names} names cannot be used: {one_line(error)}") from error


def variables(*kinds: str) -> Iterator[str]:
    """Iterate over the environment variables that name proxies. kinds: `http`, `https`, `all`."""
    for kind in kinds:
        name = f"{kind}_proxy"
        yield from [name for name in (name, name.upper()) if os.environ.get(name)][:1]
