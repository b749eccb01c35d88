"""A browser tab, the server that it opens, and the accessibility of its page."""

from dataclasses import dataclass, field
from typing import Any, Literal

from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Page

from league.registry.registry import Registry

ARGUMENTS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-component-update"]

VIOLATIONS = {"resultTypes": ["violations"]}
COLORS = {"runOnly": {"type": "rule", "values": ["color-contrast", "link-in-text-block"]}}
SCHEMES: dict[Literal["light", "dark"], dict[str, Any]] = {"light": VIOLATIONS, "dark": VIOLATIONS | COLORS}
"""Options of axe for each theme: other rules do not depend on it."""

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
    expected: set[int] = field(default_factory=set)

    def open(self, path: str) -> Page:
        self.page.goto(self.url + path)
        return self.page

    def ignore(self, status: int) -> None:
        """Ignore failed requests with a status that the test expects, also those that fail after its last step."""
        self.expected.add(status)

    def failed(self, *statuses: int) -> list[str]:
        """The messages about failed requests with one of these statuses."""
        return [error for error in self.errors if error.startswith(tuple(f"{FAILED_REQUEST}{s}" for s in statuses))]


def serious(page: Page) -> list[dict[str, Any]]:
    """The serious and critical violations of a page that axe finds in its light and its dark theme."""
    violations = []
    for scheme, options in SCHEMES.items():
        page.emulate_media(color_scheme=scheme)
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
