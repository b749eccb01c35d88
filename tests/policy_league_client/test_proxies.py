"""Proxies of the environment variables: not for this machine, and named where they fail."""

import os

import pytest

from league.errors import InvalidInput, LeagueError, RemoteError
from policy_league_client.loopback import is_loopback
from policy_league_client.proxies import through_proxy
from tests.support.clients.sync_and_async import Connect

DEAD = "http://127.0.0.1:9"
ELSEWHERE = "http://policies.example:8000"


@pytest.fixture(autouse=True)
def _without_proxies(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in list(os.environ):
        if name.lower().endswith("_proxy"):
            monkeypatch.delenv(name)


def test_this_machine() -> None:
    assert all(map(is_loopback, ("localhost", "policies.localhost", "127.0.0.1", "127.1.2.3", "::1")))
    assert not any(map(is_loopback, ("policies.example", "0.0.0.0", "10.0.0.1", "localhost.example", "")))


@pytest.mark.parametrize("proxy", [DEAD, "socks5://127.0.0.1:9", "unknown://127.0.0.1"])
def test_this_machine_is_reached_without_a_proxy(
    proxy: str, connect: Connect, url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("HTTP_PROXY", "ALL_PROXY"):
        monkeypatch.setenv(name, proxy)
    client = connect(url)
    assert client.leagues()
    with client.stream("choice") as stream:
        assert stream.act(2) == client.act("choice", 2).action


def failure(connect: Connect, *, stream: bool = False) -> LeagueError:
    with pytest.raises(LeagueError) as raised:  # noqa: PT012  a client may already be refused
        client = connect(ELSEWHERE, retry_deadline=0)
        client.stream("board").act([1]) if stream else client.leagues()
    return raised.value


def test_a_dead_proxy_is_named(connect: Connect, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("http_proxy", DEAD)
    error = failure(connect)
    assert isinstance(error, RemoteError)
    assert f"{ELSEWHERE}/v1/leagues cannot be reached through the proxy of http_proxy: " in str(error)
    assert "the connection through the proxy of http_proxy was lost: " in str(failure(connect, stream=True))
    monkeypatch.setenv("no_proxy", "policies.example")
    assert through_proxy(ELSEWHERE) == ""


@pytest.mark.parametrize("proxy", ["unknown://127.0.0.1", "socks5://[", "http://127.0.0.1:port"])
def test_a_proxy_that_cannot_be_used_is_named(proxy: str, connect: Connect, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ALL_PROXY", proxy)
    error = failure(connect)
    assert isinstance(error, InvalidInput)
    assert str(error).startswith("the proxy that ALL_PROXY names cannot be used: ")
