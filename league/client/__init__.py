"""Python client for a policy server: `Client` blocks, `AsyncClient` is its asyncio counterpart."""

from league.client._async.client import AsyncClient as AsyncClient
from league.client._async.episode import AsyncEpisode as AsyncEpisode
from league.client._async.stream import AsyncStream as AsyncStream
from league.client._sync.client import Client as Client
from league.client._sync.episode import Episode as Episode
from league.client._sync.stream import Stream as Stream
