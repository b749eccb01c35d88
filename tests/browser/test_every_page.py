"""Each page with real results: expected texts, accessibility, light and dark theme, phone width."""

import re

import pytest
from playwright.sync_api import expect

from tests.support.clients.browsers import Served, Tab, expect_finished, expect_fits, resize, serious
from tests.support.leagues.browser_leagues import CONNECT_FOUR, EMPTY, NAMED, RUN, verdict_between_versions
from tests.support.leagues.tictactoe import LEAGUE

pytestmark = pytest.mark.slow  # a browser and a server take all cores

L = f"/leagues/{LEAGUE}"
PAGES = {
    "/": (r"tictactoe", r"@3", r"two_step_game"),
    "/leagues": (r"connect_four",),
    L: (r"tictactoe@3\s*★\s*champion", r"script:random", r"95 % interval"),
    f"/leagues/{EMPTY}": (r"Champion\s*none", r"The leaderboard has not been computed yet|No games yet"),
    f"{L}/payoff": (r"always wins", r"script:random", r"α-Rank and Nash averaging.*script:random"),
    f"{L}/upsets": (r"Did better than", r"script:random"),
    f"{L}/versions": (r"tictactoe@1", r"became champion", r"Promote …"),
    f"{L}/verdicts": (r"▲ promote", r"@2"),
    f"{L}/verdicts/{{verdict}}": (r"tictactoe@\d against", r"Stronger: ", r"Blocks by result"),
    f"{L}/history": (r"rolled back", r"as it was", r"promoted by the gate"),
    f"{L}/traffic": (r"5\.0 % of requests", r"100\.0 % of requests copied"),
    f"{L}/matches?first=tictactoe%403&second=tictactoe%401": (r"tictactoe@3 against tictactoe@1", r"#\d+"),
    f"{L}/matches/{{schedule}}/0": (r"Game 0", r"Game 1"),
    f"{L}/matches/{{schedule}}/0/0": (r"player_1", r"of \d"),
    f"{L}/evaluations": (r"No evaluations yet|#\d",),
    f"{L}/evaluations/new": (r"Contestants: all versions", r"Maximum minutes"),
    f"{L}/training": (RUN, r"7\d %"),
    f"{L}/runs": (RUN, r"7\d %"),  # as in the API
    f"{L}/leaderboard": (r"script:random", r"95 % interval"),
    f"{L}/training/{RUN}": (
        r"2\d,000 of 40,000",
        r"Strength.*against script:random",
        r"Opponents.*@1\s*30\.0 %",
        r"entropy",
        r"Show all metrics",
    ),
    f"{L}/nights": (
        r"Strength",
        r"Learned exploitability",
        r"60\.0 %\s*50\.0 % to 90\.0 %\s*\+0\.20\s*0\.00 to 0\.80",
        r"Nightly runs.*▲ promote.*new",
    ),
    f"/leagues/{NAMED}": (r"The game of this league has changed", r"2 matches", r"play\.opening_plies: 4 → 0"),
    f"/leagues/{NAMED}/payoff": (r"The game of this league has changed", r"No games yet"),
    f"{L}/play": (r"tictactoe@champion \(version 3\)", r"Your agent", r"versions take their most likely actions"),
    f"/leagues/{CONNECT_FOUR}/play#opponent=script:random&agent=player_0&seed=1&actions=": (r"Your turn", r"seed 1"),
    f"{L}/nothing": (r"Page not found",),
}
E2E = ("/", L, f"{L}/payoff", f"{L}/verdicts/{{verdict}}")


@pytest.fixture(scope="module")
def names(served: Served) -> dict[str, str]:
    """Values for the placeholders of the paths."""
    verdict = verdict_between_versions(served.registry)
    return {"verdict": verdict.id, "schedule": verdict.schedule}


@pytest.mark.parametrize("path", [pytest.param(path, marks=pytest.mark.e2e) if path in E2E else path for path in PAGES])
def test_a_page(tab: Tab, names: dict[str, str], path: str) -> None:
    page = tab.open(path.format(**names))
    for words in PAGES[path]:
        expect(page.locator("body")).to_contain_text(re.compile(words))
    expect_finished(page)
    expect(page).to_have_title(re.compile(". · Policy League$"))
    assert serious(page) == []
    resize(page, 360)  # a phone
    expect_fits(page)


def test_a_dialog(tab: Tab) -> None:
    page = tab.open(L)
    page.get_by_role("button", name="Roll back …").click()
    expect(page.get_by_role("dialog")).to_contain_text(re.compile(r"becomes champion again and replaces\s+tictactoe@"))
    assert serious(tab.page) == []
    page.keyboard.press("Escape")
    expect(page.get_by_role("dialog")).to_have_count(0)
    expect(page.get_by_role("button", name="Roll back …")).to_be_focused()


def test_the_note_dialog(tab: Tab) -> None:
    page = tab.open(f"{L}/versions")
    page.get_by_role("button", name=f"Edit the note of {LEAGUE}@2").click()
    expect(page.get_by_role("dialog", name=f"Note of {LEAGUE}@2")).to_contain_text("Save an empty note to delete it")
    assert serious(tab.page) == []


def test_results_of_an_earlier_game(tab: Tab) -> None:
    page = tab.open(f"/leagues/{NAMED}")
    expect(page.get_by_text("No games yet")).to_be_visible()
    page.get_by_text("The game of this league has changed").click()
    page.get_by_role("link", name="2 matches").click()
    expect(page.get_by_role("row", name=re.compile("script:one_ply"))).to_be_visible()
    expect(page.get_by_text("These are results of an earlier game")).to_be_visible()
    assert serious(tab.page) == []
    page.get_by_role("link", name="Show current results").click()
    expect(page.get_by_text("No games yet")).to_be_visible()


def test_an_unknown_league(tab: Tab) -> None:
    page = tab.open("/leagues/chess/verdicts")
    expect(page.get_by_role("heading", level=1)).to_have_text("League chess not found")
    tab.ignore(404)


def test_the_first_paint_waits_for_no_data(tab: Tab) -> None:
    """The title and the tabs are shown even if the API does not respond."""
    tab.page.route("**/v1/**", lambda route: None)
    page = tab.open(L)
    expect(page.get_by_role("heading", level=1)).to_have_text(LEAGUE)
    expect(page.get_by_role("navigation", name=re.compile("Pages"))).to_be_visible()


def test_the_theme_is_selected_and_stored(tab: Tab) -> None:
    page = tab.open("/")
    background = "getComputedStyle(document.body).backgroundColor"
    light = page.evaluate(background)
    switch = page.get_by_role("button", name="Theme")
    switch.click()  # light
    switch.click()  # dark
    expect(switch).to_have_accessible_name("Theme: dark")
    dark = page.evaluate(background)
    page.reload()
    assert page.evaluate(background) == dark != light


def test_a_phone_shows_the_selected_tab(tab: Tab) -> None:
    tab.page.set_viewport_size({"width": 360, "height": 740})
    page = tab.open(f"{L}/play")
    expect(page.get_by_role("link", name="Play", exact=True)).to_be_in_viewport(ratio=0.9)


def test_pages_are_navigable_by_keyboard(tab: Tab) -> None:
    page = tab.open("/")
    expect(page.get_by_role("link", name=LEAGUE, exact=True)).to_be_visible()
    page.keyboard.press("Tab")
    expect(page.get_by_role("link", name="Skip to content")).to_be_focused()
    page.get_by_role("link", name=LEAGUE, exact=True).focus()
    page.keyboard.press("Enter")
    expect(page.get_by_role("heading", level=1)).to_have_text(LEAGUE)
    page.get_by_role("link", name="Payoff matrix").focus()
    page.keyboard.press("Enter")
    cell = page.get_by_role("link", name=re.compile("tictactoe@3 scores .* against script:random"))
    cell.focus()
    page.keyboard.press("Enter")
    expect(page.get_by_role("heading", level=2)).to_contain_text("against script:random")
    page.go_back()
    expect(page.get_by_role("heading", level=2)).to_have_text("Payoff matrix")


def test_a_long_list_is_shown_page_by_page(tab: Tab) -> None:
    page = tab.open(f"{L}/matches")
    rows = page.locator("tbody tr")
    expect(rows).to_have_count(50)
    page.get_by_role("button", name="Show more").click()
    expect(rows).to_have_count(100)
    assert len(set(page.locator("tbody th a").evaluate_all("links => links.map(link => link.href)"))) == 100
