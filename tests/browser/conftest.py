"""A real server with leagues that have results, and a browser."""

from collections.abc import Iterator
from pathlib import Path
from shutil import which

import pytest
from playwright.sync_api import Browser, expect, sync_playwright

from serve_app.runtime.launch import running
from tests.support.clients.browsers import ARGUMENTS, Served, Tab
from tests.support.leagues import browser_leagues
from tests.support.leagues.tictactoe import LEAGUE

TIMEOUT = 60_000
"""Timeout of each expectation, in milliseconds."""
MOST_BUSY = 3
"""Requests of a test that a busy machine may answer with 503 or 504."""


@pytest.fixture(scope="package")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with browser_leagues.leagues_of_every_page(tmp_path_factory.mktemp("pages")) as registry:
        keys = {name: registry.keys.create(name, scopes)[1] for name, scopes in browser_leagues.KEYS.items()}
        with pytest.MonkeyPatch.context() as environment:
            environment.setenv("RAY_SERVE_DIRECT_INGRESS_MIN_DRAINING_PERIOD_S", "2")
            with running(registry.storage, replicas=1, insecure=True) as url:
                for league in (LEAGUE, browser_leagues.CONNECT_FOUR):
                    browser_leagues.answer("GET", f"{url}/v1/leagues/{league}/playable")  # the service has started
                yield Served(url, registry, keys)


@pytest.fixture(scope="package")
def browser() -> Iterator[Browser]:
    """The Chromium of the system, or the one of Playwright."""
    with sync_playwright() as playwright:
        path = which("chromium") or playwright.chromium.executable_path
        if not Path(path).is_file():
            pytest.skip("no browser is installed: `apt install chromium`, or `playwright install chromium`")
        browser = playwright.chromium.launch(executable_path=path, args=ARGUMENTS)
        yield browser
        browser.close()


@pytest.fixture
def tab(served: Served, browser: Browser) -> Iterator[Tab]:
    """A tab in a new session."""
    context = browser.new_context(viewport={"width": 1180, "height": 800})
    context.set_default_timeout(TIMEOUT)
    expect.set_options(timeout=TIMEOUT)
    tab = Tab(context.new_page(), served.url)
    tab.page.on(
        "console", lambda message: tab.errors.append(message.text) if message.type in ("error", "warning") else None
    )
    tab.page.on("pageerror", lambda error: tab.errors.append(str(error)))
    yield tab
    context.close()
    busy = tab.failed(503, 504)
    assert len(busy) <= MOST_BUSY, "the pages repeat such a request"
    ignored = {*busy, *tab.failed(*tab.expected)}
    assert [error for error in tab.errors if error not in ignored] == []
