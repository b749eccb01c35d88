"""Python client for a policy server: `Client` blocks, `AsyncClient` is its asyncio counterpart."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from policy_league_client._async.client import AsyncClient
    from policy_league_client._async.episode import AsyncEpisode
    from policy_league_client._async.stream import AsyncStream
    from policy_league_client._sync.client import Client
    from policy_league_client._sync.episode import Episode
    from policy_league_client._sync.stream import Stream

__version__ = "0.1.0"
__all__ = ["AsyncClient", "AsyncEpisode", "AsyncStream", "Client", "Episode", "Stream"]


# Programs that need only the errors and references, such as most commands, do not wait for httpx and websockets.
def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    folder = "_async" if name.startswith("Async") else "_sync"
    return getattr(import_module(f"{__name__}.{folder}.{name.removeprefix('Async').lower()}"), name)
