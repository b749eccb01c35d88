"""Numbers as text: the module that all pages use, in a browser without a server."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page

pytestmark = pytest.mark.slow
MODULE = Path(__file__).parents[2] / "serve_app" / "pages" / "format.js"
ORIGIN = "https://page.test/"


@pytest.fixture(scope="module")
def page(browser: Browser) -> Iterator[Page]:
    page = browser.new_page(locale="de-DE")  # numbers are English in each locale
    page.route(ORIGIN, lambda route: route.fulfill(body="<!doctype html>", content_type="text/html"))
    page.route(
        f"{ORIGIN}format.js", lambda route: route.fulfill(body=MODULE.read_text(), content_type="text/javascript")
    )
    page.goto(ORIGIN)
    yield page
    page.close()


VALUES: list[tuple[str, list[Any], str]] = [
    ("percent", [0.5], "50.0 %"),
    ("percent", [0], "0.0 %"),
    ("percent", [1], "100.0 %"),
    ("percent", [0.000027, 2], "0.0027 %"),
    ("percent", [0.00004], "0.0040 %"),
    ("percent", [0.126, 0], "13 %"),
    ("percent", [None], "–"),
    ("count", [1234567], "1,234,567"),
    ("signed", [12.4], "+12"),
    ("signed", [-12.4], "−12"),
    ("signed", [-0.3], "0"),
    ("number", [-1.5], "−1.50"),
    ("number", [1.5], "1.50"),
    ("short", [0.000123], "1.23e−4"),
    ("short", [61440], "61,440"),
    ("short", [4_800_000], "4.8M"),
    ("short", [0.0123], "0.0123"),
    ("short", [-12345.678], "−12,350"),
    ("short", [0.00123456], "0.001235"),
    ("mixture", [[{"version": 3, "probability": 0.6}, {"version": 5, "probability": 0.4}]], "60.0 % @3, 40.0 % @5"),
    ("interval", [[-3, 12.2]], "−3 to +12"),
    ("interval", [[None, 12.2]], "−∞ to +12"),
    ("rate", [0], "0"),
    ("rate", [2.34], "2.3"),
    ("rate", [1234.5], "1,235"),
    ("shortRef", ["board@3"], "@3"),
    ("shortRef", ["script:random"], "script:random"),
    ("shortRef", ["http://127.0.0.1:8000/v2/models/a@b"], "http://127.0.0.1:8000/v2/models/a@b"),
    ("shortVerdict", ["connect_four-verdict-0f3a62d1c8b45e97-1b2c3d4e"], "0f3a62d1"),
    ("plural", [1, "game"], "1 game"),
    ("plural", [2000, "game"], "2,000 games"),
]


def test_a_value_as_text(page: Page, subtests: pytest.Subtests) -> None:
    for function, arguments, text in VALUES:
        with subtests.test(function, arguments=arguments):
            call = "async ([name, values]) => (await import('/format.js'))[name](...values)"
            assert page.evaluate(call, [function, arguments]) == text
