"""The pages behind a proxy that serves them below a path prefix, which it removes from the paths of requests."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import expect

from policy_league_client import Client
from serve_app.runtime import serve_bypass
from tests.support.clients.browsers import Served, Tab, use_key
from tests.support.leagues import tictactoe
from tests.support.leagues.browser_leagues import CONNECT_FOUR, RUN, verdict_between_versions
from tests.support.leagues.tictactoe import LEAGUE
from tests.support.servers.proxies import Proxy, proxy
from tests.support.servers.replicas import QUICK
from tests.support.servers.streaming import listening

pytestmark = pytest.mark.slow  # a browser and a server take all cores

L = f"/leagues/{LEAGUE}"


@pytest.fixture(scope="module", params=["/ai", "/games/leagues"])
def proxied(
    served: Served, tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest
) -> Iterator[Proxy]:
    with proxy(tmp_path_factory.mktemp("proxy"), served.url, request.param) as server:
        yield server


def test_all_requests_of_the_pages_are_below_the_prefix(tab: Tab, served: Served, proxied: Proxy) -> None:
    requested: list[str] = []
    tab.page.on("request", lambda request: requested.append(request.url))
    schedule = verdict_between_versions(served.registry).schedule
    texts = {
        "/": "two_step_game",
        "/leagues": "two_step_game",
        L: "95 % interval",
        f"{L}/payoff": "always wins",
        f"{L}/runs/{RUN}": "entropy",
        f"{L}/matches/{schedule}/0/0": "Step|Start",
        f"/leagues/{CONNECT_FOUR}/play#opponent=script:random&agent=player_0&seed=1&actions=": "Your turn",
        f"{L}/nothing": "Page not found",
        "/docs": "Get the leaderboard",
    }
    for path, text in texts.items():
        tab.page.goto(proxied.url + path)
        expect(tab.page.locator("main")).to_contain_text(re.compile(text))
    outside = {url for url in requested if not url.startswith((f"{proxied.url}/", "data:"))}
    assert outside == set()


def test_links_lead_to_pages_below_the_prefix(tab: Tab, proxied: Proxy) -> None:
    page = tab.page
    page.goto(f"{proxied.url}/")
    page.get_by_role("link", name=LEAGUE, exact=True).click()
    expect(page).to_have_url(proxied.url + L)
    page.get_by_role("link", name="Payoff matrix").click()
    page.get_by_role("link", name=re.compile("tictactoe@3 scores .* against script:random")).click()
    page.get_by_role("link", name=re.compile("^Match ")).first.click()
    page.get_by_role("link", name="Game 1").click()
    expect(page.get_by_role("heading", level=2)).to_have_text("Game 1")
    page.reload()
    expect(page.get_by_role("heading", level=2)).to_have_text("Game 1")
    page.get_by_role("link", name="Policy League").click()
    expect(page).to_have_url(f"{proxied.url}/")
    page.get_by_role("link", name="API", exact=True).click()
    expect(page).to_have_url(f"{proxied.url}/docs")


def test_event_streams_and_changes_pass_the_proxy(tab: Tab, served: Served, proxied: Proxy) -> None:
    page = tab.page
    page.goto(proxied.url + L)
    champion = page.get_by_role("row").filter(has_text="★")
    expect(champion).to_contain_text(f"{LEAGUE}@3")
    served.registry.aliases.set(LEAGUE, "champion", 2, expected=3, actor="cli", reason="from elsewhere")
    expect(champion).to_contain_text(f"{LEAGUE}@2")
    use_key(page, served.keys["everything"])
    page.get_by_role("button", name="Roll back …").click()
    page.get_by_label("Reason").fill("as it was")
    page.get_by_role("button", name="Roll back to @3").click()
    expect(champion).to_contain_text(f"{LEAGUE}@3")
    page.goto(f"{served.url}/")  # a server of another prefix, if it were of the same origin
    assert page.evaluate("sessionStorage.length") == 0


def test_the_documentation_sends_requests_below_the_prefix(tab: Tab, proxied: Proxy) -> None:
    page = tab.page
    page.goto(f"{proxied.url}/docs/")  # redirected
    operation = page.locator("details.operation").filter(has_text="Get the permissions of the API key")
    operation.locator("summary").first.click()
    with page.expect_request(f"{proxied.url}/v1/key"):
        operation.get_by_role("button", name="Send").click()
    expect(operation.locator(".response")).to_contain_text("200")


def test_a_proxy_that_leaves_the_prefix_needs_the_root_path(
    tab: Tab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    registry = tictactoe.registry(tmp_path / "home")
    for _ in range(2):
        tictactoe.publish(registry, tictactoe.graph())
    registry.aliases.set(LEAGUE, "champion", 1, expected=None, actor="cli", reason="the first")
    monkeypatch.setattr(serve_bypass, "_root_path", "/ai")  # as PolicyServer sets it
    settings = QUICK.model_copy(update={"root_path": "/ai"})
    with listening(registry.storage, settings) as server, proxy(tmp_path, server.url, "/ai", strips=False) as proxied:
        page = tab.page
        page.goto(f"{proxied.url}/")
        page.get_by_role("link", name=LEAGUE, exact=True).click()
        expect(page.locator(".properties")).to_contain_text(f"{LEAGUE}@1")
        page.get_by_role("link", name="History").click()
        page.reload()
        expect(page.get_by_role("table")).to_contain_text("the first")
        registry.aliases.set(LEAGUE, "champion", 2, expected=1, actor="cli", reason="the second")
        expect(page.get_by_role("table")).to_contain_text("the second")  # by an event
        page.goto(f"{proxied.url}/docs")
        expect(page.locator("main")).to_contain_text("Get the leaderboard")
        assert page.request.get(f"{proxied.url}/openapi.json").json()["servers"] == [{"url": "/ai"}]
    registry.close()


def test_clients_call_the_server_below_the_prefix(served: Served, proxied: Proxy) -> None:
    observation = {"observation": np.zeros((3, 3, 2), np.int8), "action_mask": np.ones(9, np.int8)}
    with Client(proxied.url, key=served.keys["everything"]) as client:
        assert LEAGUE in [league["league"] for league in client.leagues()]
        with client.stream(LEAGUE) as stream:  # a WebSocket
            assert stream.act(observation) == client.act(LEAGUE, observation).action
