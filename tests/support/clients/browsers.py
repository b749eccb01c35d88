"""A browser tab, the server that it opens, what tests do in its page and wait for, and its accessibility."""

import re
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import ConsoleMessage, Locator, Page, Response, expect

from league.registry.registry import Registry
from tests.support.waiting import until

SECONDS = 60
"""How long a test waits for a page: a busy machine needs long for it."""
TIMEOUT = 1000 * SECONDS
"""The same in milliseconds, for each expectation."""

ARGUMENTS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-component-update"]

VIOLATIONS = {"resultTypes": ["violations"]}
COLORS = {"runOnly": {"type": "rule", "values": ["color-contrast", "link-in-text-block"]}}
SCHEMES: dict[Literal["light", "dark"], dict[str, Any]] = {"light": VIOLATIONS, "dark": VIOLATIONS | COLORS}
"""Options of axe for each theme: other rules do not depend on it."""

FAILED_REQUEST = "Failed to load resource: the server responded with a status of "
"""The console message of Chromium for each failed request, even if the page handles it."""
BUSY = (503, 504)
"""The statuses of a server on a busy machine."""
UNFINISHED = ".loading, .plot:not(:has(canvas)), .screen:not(:has(img))"
"""What a page contains until it shows its data, charts and pictures."""
SCROLLS = "document.documentElement.scrollWidth > document.documentElement.clientWidth"


@dataclass(frozen=True, slots=True)
class Served:
    """A server, its registry, and API keys by name."""

    url: str
    registry: Registry
    keys: dict[str, str]


@dataclass
class Tab:
    """A tab that collects warnings and errors of the browser, and the requests that its page has to repeat."""

    page: Page
    url: str
    errors: list[str] = field(default_factory=list)
    expected: set[int] = field(default_factory=set)
    pending: set[str] = field(default_factory=set)
    """The URLs for which the current page got one of the statuses BUSY, and nothing else since."""

    def __post_init__(self) -> None:
        self.page.on("console", self._log)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("response", self._receive)
        self.page.on("framenavigated", lambda _: self.pending.clear())  # the next page has other requests

    def _log(self, message: ConsoleMessage) -> None:
        if message.type in ("error", "warning"):
            self.errors.append(message.text)

    def _receive(self, response: Response) -> None:
        if response.status in BUSY:
            self.pending.add(response.url)
        else:
            self.pending.discard(response.url)

    def is_answered(self) -> bool:
        """Whether each request that a busy server refused has been repeated with success."""
        self.page.evaluate("0")  # receives what has happened since the last call
        return not self.pending

    def open(self, path: str) -> Page:
        self.page.goto(self.url + path)
        return self.page

    def ignore(self, status: int) -> None:
        """Ignore failed requests with a status that the test expects, also those that fail after its last step."""
        self.expected.add(status)

    def failed(self, *statuses: int) -> list[str]:
        """The messages about failed requests with one of these statuses."""
        return [error for error in self.errors if error.startswith(tuple(f"{FAILED_REQUEST}{s}" for s in statuses))]


def key_button(page: Page) -> Locator:
    """The button that opens the dialog for the API key, and shows whether the key is valid."""
    return page.get_by_role("button", name=re.compile("^API key"))


def key_dialog(page: Page) -> Locator:
    """The dialog for the API key."""
    return page.get_by_role("dialog", name="API key")


def submit_key(page: Page, key: str) -> None:
    """Enter a key in the open dialog."""
    key_dialog(page).get_by_label("Key", exact=True).fill(key)
    page.get_by_role("button", name="Use key").click()


def enter_key(page: Page, key: str) -> None:
    """Enter a valid key in the open dialog, and wait until it closes."""
    submit_key(page, key)
    expect(key_dialog(page)).to_have_count(0)


def use_key(page: Page, key: str) -> None:
    """Open the dialog for the key, and enter a valid key. The page is then loaded anew."""
    key_button(page).click()
    enter_key(page, key)


def expect_finished(page: Page) -> None:
    """Wait until a page shows all that it loads. Within a document, wait for something of the new page before."""
    expect(page.locator("h1")).to_have_count(1)
    expect(page.locator(UNFINISHED)).to_have_count(0)


def expect_fits(page: Page) -> None:
    """Wait until a page does not scroll horizontally: charts are drawn again after a resize."""
    until(lambda: not page.evaluate(SCROLLS), SECONDS)


def resize(page: Page, width: int) -> None:
    """Change the width of a page, and wait until it has it."""
    page.set_viewport_size({"width": width, "height": 800})
    until(lambda: page.evaluate("innerWidth") == width, SECONDS)


def serious(page: Page) -> list[dict[str, Any]]:
    """The serious and critical violations of a page that axe finds in its light and its dark theme."""
    violations = []
    for scheme, options in SCHEMES.items():
        page.emulate_media(color_scheme=scheme)
        until(partial(page.evaluate, f"matchMedia('(prefers-color-scheme: {scheme})').matches"), SECONDS)
        violations += [
            {
                "rule": violation["id"],
                "scheme": scheme,
                "at": [node["html"][:200] + str(node.get("failureSummary"))[:300] for node in violation["nodes"]],
            }
            for violation in Axe().run(page, options=options).response["violations"]
            if violation["impact"] in ("serious", "critical")
        ]
    return violations
