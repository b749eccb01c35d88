"""The client of a policy server."""

from league.client.async_client import AsyncClient as AsyncClient
from league.client.client import Client as Client
