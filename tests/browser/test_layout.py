"""Long names and texts, many versions, and the position that a page had before the user left it."""

import re

import pytest
from playwright.sync_api import Route, expect

from tests.support.clients.browsers import Tab, expect_finished, expect_fits
from tests.support.leagues.browser_leagues import LONG
from tests.support.leagues.tictactoe import LEAGUE
from tests.support.waiting import until

pytestmark = pytest.mark.slow  # a browser and a server take all cores

L = f"/leagues/{LEAGUE}"
GAME = "#opponent=script:random&agent=player_1&seed=1&actions="


@pytest.mark.parametrize("width", [390, 1180])
def test_long_names_do_not_overflow(tab: Tab, width: int) -> None:
    tab.page.set_viewport_size({"width": width, "height": 800})
    pages = (
        "",
        "/play",
        "/payoff",
        "/versions",
        "/history",
        "/traffic",
        "/evaluations/new",
        "/matches",
        f"/play{GAME}",  # not after another address of its document, which would satisfy what follows
    )
    for path in ("/", *(f"/leagues/{LONG}{page}" for page in pages)):
        page = tab.open(path)
        expect(page.locator("main")).to_contain_text("n" * 60)
        expect_finished(page)
        expect_fits(page)


def test_the_documentation_does_not_overflow_on_a_phone(tab: Tab) -> None:
    tab.page.set_viewport_size({"width": 390, "height": 844})
    page = tab.open("/docs")
    expect(page.locator("main")).to_contain_text("Get the leaderboard")
    page.evaluate("document.querySelectorAll('details').forEach(each => { each.open = true; })")
    expect(page.locator("details.operation:not(:has(.inside))")).to_have_count(0)  # each is rendered when it is opened
    expect(page.get_by_role("button", name="Send").first).to_be_visible()
    expect_fits(page)


@pytest.mark.parametrize("width", [390, 1180])
def test_rows_with_long_texts_are_short_until_they_are_opened(tab: Tab, width: int) -> None:
    tab.page.set_viewport_size({"width": width, "height": 800})
    page = tab.open(f"/leagues/{LONG}/history")
    row = page.locator("tbody tr")
    expect(row).to_have_count(1)
    assert row.evaluate("row => row.offsetHeight") < 120
    row.locator("summary", has_text="why").click()
    until(lambda: row.evaluate("row => row.offsetHeight") > 200)


def test_the_form_of_an_evaluation_is_short_with_many_versions(tab: Tab) -> None:
    def many(route: Route) -> None:
        reply = route.fetch()
        first = reply.json()["versions"][0]
        versions = [first | {"version": number, "aliases": []} for number in range(1, 506)]
        route.fulfill(response=reply, json={"league": LEAGUE, "versions": versions, "next": None})

    tab.page.route(re.compile(rf"/v1{L}/versions(\?|$)"), many)
    page = tab.open(f"{L}/evaluations/new")
    expect(page.get_by_label("@505", exact=True)).to_be_attached()
    assert page.evaluate("document.documentElement.scrollHeight") < 1400


def test_back_leads_to_the_same_position(tab: Tab) -> None:
    page = tab.open(f"{L}/matches")
    rows = page.locator("tbody tr")
    page.get_by_role("button", name="Show more").click()
    expect(rows).to_have_count(100)
    link = rows.nth(90).get_by_role("link")
    link.scroll_into_view_if_needed()
    name = str(link.get_attribute("aria-label"))
    until(lambda: page.evaluate("history.state?.scroll === scrollY"))
    link.click()
    expect(page.get_by_role("table", name="Games")).to_be_visible()
    until(lambda: page.evaluate("scrollY") == 0)
    page.go_back()
    expect(page.get_by_role("link", name=name)).to_be_in_viewport()
    page.get_by_role("link", name=name).click()
    expect(page.get_by_role("table", name="Games")).to_be_visible()
    page.reload()
    page.go_back()  # also to another document
    expect(page.get_by_role("link", name=name)).to_be_in_viewport()
