"""A real server with leagues that have results, and a browser."""

from collections.abc import Iterator
from pathlib import Path
from shutil import which

import pytest
from playwright.sync_api import Browser, expect, sync_playwright

from league.registry.aliases import ANY
from serve_app.runtime.launch import running
from tests.support.clients.browsers import ARGUMENTS, BUSY, SECONDS, TIMEOUT, Served, Tab
from tests.support.leagues import browser_leagues
from tests.support.leagues.tictactoe import LEAGUE
from tests.support.waiting import until


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
        expect.set_options(timeout=TIMEOUT)
        yield browser
        browser.close()


@pytest.fixture
def tab(served: Served, browser: Browser) -> Iterator[Tab]:
    """A tab in a new session. The champion is version 3, whatever a test before has left."""
    served.registry.aliases.set(LEAGUE, "champion", 3, expected=ANY, actor="cli", reason="as it was")
    with browser.new_context(viewport={"width": 1180, "height": 800}) as context:
        context.set_default_timeout(TIMEOUT)
        tab = Tab(context.new_page(), served.url)
        yield tab
        until(tab.is_answered, SECONDS)  # a busy server may have refused any number of requests: the page repeats them
        tab.page.unroute_all(behavior="ignoreErrors")  # a handler may be at work
    ignored = tab.failed(*BUSY, *tab.expected)
    assert [error for error in tab.errors if error not in ignored] == []
