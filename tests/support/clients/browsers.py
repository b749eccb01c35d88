"""A browser tab, the server that it opens, and the accessibility of its page."""

from dataclasses import dataclass, field
from typing import Any

from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Page

from league.registry.registry import Registry

ARGUMENTS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-component-update"]

FAILED_REQUEST = "Failed to load resource: the server responded with a status of "
"""The console message of Chromium for each failed request, even if the page handles it."""


@dataclass(frozen=True, slots=True)
class Served:
    """A server, its registry, and API keys by name."""

    url: str
    registry: Registry
    keys: dict[str, str]


@dataclass
class Tab:
    """A tab that collects warnings and errors of the browser."""

    page: Page
    url: str
    errors: list[str] = field(default_factory=list)

    def open(self, path: str) -> Page:
        self.page.goto(self.url + path)
        return self.page

    def ignore(self, status: int) -> None:
        """Ignore failed requests with a status that the test expects."""
        self.errors = [error for error in self.errors if not error.startswith(f"{FAILED_REQUEST}{status}")]


def serious(page: Page) -> list[dict[str, Any]]:
    """The serious and critical violations of a page that axe finds."""
    violations = Axe().run(page).response["violations"]
    return [
        {
            "rule": violation["id"],
            "at": [node["html"][:200] + str(node.get("failureSummary"))[:300] for node in violation["nodes"]],
        }
        for violation in violations
        if violation["impact"] in ("serious", "critical")
    ]
