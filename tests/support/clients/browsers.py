"""A browser tab and the server that it opens."""

from dataclasses import dataclass, field

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
