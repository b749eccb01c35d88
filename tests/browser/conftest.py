"""A real server with leagues that have results, and a browser before it."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from shutil import which

import pytest
from playwright.sync_api import Browser, Page, expect, sync_playwright

from league.registry.registry import Registry
from serve_app.launch import running
from tests.browser import leagues
from tests.evaluation.examples import LEAGUE

ARGUMENTS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-component-update"]
PATIENCE = 20_000
"""Milliseconds for whatever is to come: a machine may be busy."""
EXPECTED = "Failed to load resource: the server responded with a status of "
"""What a browser says of every request that is refused, however well the page takes it."""


@dataclass(frozen=True, slots=True)
class Served:
    """A server, its registry, and keys for it by name."""

    url: str
    registry: Registry
    keys: dict[str, str]


@pytest.fixture(scope="package")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with leagues.of_every_page(tmp_path_factory.mktemp("pages")) as registry:
        keys = {name: registry.create_key(name, scopes)[1] for name, scopes in leagues.KEYS.items()}
        with pytest.MonkeyPatch.context() as environment:
            environment.setenv("RAY_SERVE_DIRECT_INGRESS_MIN_DRAINING_PERIOD_S", "2")
            with running(registry.storage, replicas=1, insecure=True) as url:
                for league in (LEAGUE, leagues.CONNECT_FOUR):
                    leagues.answer("GET", f"{url}/v1/leagues/{league}/playable")  # the studio has started
                yield Served(url, registry, keys)


@pytest.fixture(scope="package")
def browser() -> Iterator[Browser]:
    """Debian's Chromium, or Playwright's own."""
    with sync_playwright() as playwright:
        path = which("chromium") or playwright.chromium.executable_path
        if not Path(path).is_file():
            pytest.skip("no browser is installed: `apt install chromium`, or `playwright install chromium`")
        browser = playwright.chromium.launch(executable_path=path, args=ARGUMENTS)
        yield browser
        browser.close()


@dataclass
class Tab:
    """A tab that notes whatever the browser complains of."""

    page: Page
    url: str
    complaints: list[str] = field(default_factory=list)

    def open(self, path: str) -> Page:
        self.page.goto(self.url + path)
        return self.page

    def forgive(self, status: int) -> None:
        """Requests that were refused with a status were meant to be."""
        self.complaints = [each for each in self.complaints if not each.startswith(f"{EXPECTED}{status}")]


@pytest.fixture
def tab(served: Served, browser: Browser, request: pytest.FixtureRequest) -> Iterator[Tab]:
    """A tab of its own session. Parametrised indirectly: options of its context."""
    context = browser.new_context(**{"viewport": {"width": 1180, "height": 800}} | getattr(request, "param", {}))
    context.set_default_timeout(PATIENCE)
    expect.set_options(timeout=PATIENCE)
    tab = Tab(context.new_page(), served.url)
    tab.page.on("console", lambda said: tab.complaints.append(said.text) if said.type in ("error", "warning") else None)
    tab.page.on("pageerror", lambda error: tab.complaints.append(str(error)))
    yield tab
    context.close()
    assert tab.complaints == []
