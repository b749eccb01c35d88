"""Changes by users and live updates: promotions, evaluations, notes, API keys."""

import re
from pathlib import Path

import pytest
from playwright.sync_api import Page, Route, expect

from league.refs import CheckpointRef
from tests.support.clients.browsers import (
    Served,
    Tab,
    enter_key,
    expect_finished,
    key_button,
    key_dialog,
    resize,
    submit_key,
    use_key,
)
from tests.support.leagues.browser_leagues import CONNECT_FOUR, EMPTY, NAMED, RUN, record
from tests.support.leagues.reported_league import HOSTILE
from tests.support.leagues.tictactoe import LEAGUE
from tests.support.servers.proxies import proxy

pytestmark = pytest.mark.slow  # a browser and a server take all cores

PAGES = Path(__file__).parents[2] / "serve_app" / "pages"
L = f"/leagues/{LEAGUE}"
SLOW = 240_000
"""Timeout in milliseconds for work of the evaluation service, which has the lowest priority."""


def expect_champion(page: Page, version: int) -> None:
    """Wait until the leaderboard shows this champion."""
    row = page.get_by_role("row").filter(has_text="★")
    expect(row).to_have_count(1)
    expect(row).to_contain_text(f"{LEAGUE}@{version}")


def shorten(page: Page, module: str, name: str) -> None:
    """Serve a module of the pages in which an interval that tests wait for is half a second."""
    code, number = re.subn(rf"(?<=const {name} = )\d+", "500", (PAGES / module).read_text())
    assert number == 1
    page.route(f"**/pages/{module}", lambda route: route.fulfill(body=code, content_type="text/javascript"))


@pytest.mark.e2e
def test_a_promotion_and_a_rollback_change_the_leaderboard_without_reload(tab: Tab, served: Served) -> None:
    page = tab.open(L)
    page.evaluate("window.isSameDocument = true")
    expect_champion(page, 3)
    page.get_by_role("button", name="Promote …").click()
    dialog = page.get_by_role("dialog", name=f"Promote a version of {LEAGUE}")
    dialog.get_by_label("Version").select_option("2")
    expect(dialog).to_contain_text(f"{LEAGUE}@2 becomes champion and replaces {LEAGUE}@3")
    dialog.get_by_label("Reason").fill(HOSTILE)
    dialog.get_by_role("button", name="Promote @2").click()
    enter_key(page, served.keys["everything"])
    expect_champion(page, 2)
    tab.ignore(401)
    event = served.registry.aliases.history(LEAGUE)[0]
    assert (event.version, event.previous, event.actor, event.reason) == (2, 3, "everything", HOSTILE)

    page.get_by_role("button", name="Roll back …").click()
    dialog = page.get_by_role("dialog", name=f"Roll back {LEAGUE}")
    expect(dialog).to_contain_text(re.compile(rf"{LEAGUE}@3 becomes champion again and replaces\s+{LEAGUE}@2"))
    dialog.get_by_label("Reason").fill("it was a try")
    dialog.get_by_role("button", name="Roll back to @3").click()
    expect_champion(page, 3)
    assert page.evaluate("window.isSameDocument"), "the document was not reloaded"


def test_actions_without_the_required_scope_are_disabled(tab: Tab, served: Served) -> None:
    page = tab.open(f"{L}/versions")
    expect(page.get_by_role("button", name=f"Promote {LEAGUE}@1")).to_be_enabled()
    use_key(page, served.keys["evaluator"])
    for name in ("Promote …", "Roll back …", f"Promote {LEAGUE}@1"):
        expect(page.get_by_role("button", name=name, exact=True)).to_be_disabled()
    expect(page.get_by_title(f"The key evaluator does not have the scope promote in {LEAGUE}.").first).to_be_visible()
    use_key(page, served.keys["reader"])
    page.get_by_role("link", name="Evaluations").click()
    expect(page.get_by_text(f"The key reader does not have the scope evaluate in {LEAGUE}.")).to_be_visible()
    expect(page.get_by_role("link", name="New evaluation")).to_have_count(0)


def test_promotions_by_others_are_shown(tab: Tab, served: Served) -> None:
    page = tab.open(L)
    expect_champion(page, 3)
    served.registry.aliases.set(LEAGUE, "champion", 1, expected=3, actor="cli", reason="from elsewhere")
    expect_champion(page, 1)
    served.registry.aliases.rollback(LEAGUE, actor="cli", reason="from elsewhere")
    expect_champion(page, 3)


def test_a_promotion_fails_if_the_champion_has_changed(tab: Tab, served: Served) -> None:
    page = tab.open(f"{L}/versions")
    use_key(page, served.keys["everything"])
    page.get_by_role("button", name=f"Promote {LEAGUE}@1").click()
    dialog = page.get_by_role("dialog", name=f"Promote {LEAGUE}@1")
    expect(dialog).to_be_visible()  # with the champion of now
    served.registry.aliases.set(LEAGUE, "champion", 2, expected=3, actor="cli", reason="faster")
    dialog.get_by_label("Reason").fill("slower")
    dialog.get_by_role("button", name="Promote @1").click()
    expect(dialog.get_by_role("alert")).to_contain_text("The request failed")
    tab.ignore(409)


def test_exploiters_and_retired_versions_cannot_be_promoted(tab: Tab) -> None:
    changes = {1: {"role": "exploiter", "exploits": f"{LEAGUE}@3"}, 2: {"retired_at": "2026-11-21T04:12:09+00:00"}}

    def change(route: Route) -> None:
        reply = route.fetch()
        document = reply.json()
        versions = [version | changes.get(version["version"], {}) for version in document["versions"]]
        route.fulfill(response=reply, json=document | {"versions": versions})

    tab.page.route(re.compile(rf"/v1{L}/versions(\?|$)"), change)
    page = tab.open(f"{L}/versions")
    expect(page.get_by_role("row").filter(has_text=f"{LEAGUE}@2")).to_contain_text("retired")
    for version in (1, 2):
        expect(page.get_by_role("button", name=f"Promote {LEAGUE}@{version}")).to_have_count(0)
    page.get_by_role("button", name="Promote …", exact=True).click()
    dialog = page.get_by_role("dialog", name=f"Promote a version of {LEAGUE}")
    expect(dialog.get_by_label("Version")).to_be_visible()
    for version in (1, 2):
        expect(dialog.get_by_role("option", name=f"{LEAGUE}@{version}")).to_have_count(0)

    page = tab.open(f"{L}/evaluations/new")
    expect(page.get_by_label("@1 exploiter of @3")).to_be_visible()
    expect(page.get_by_label("@2", exact=True)).to_have_count(0)


def test_a_key_without_the_scope_gets_an_error(tab: Tab, served: Served) -> None:
    page = tab.open(L)
    page.get_by_role("button", name="Roll back …").click()
    dialog = page.get_by_role("dialog", name=f"Roll back {LEAGUE}")
    dialog.get_by_label("Reason").fill("not permitted")
    dialog.get_by_role("button", name="Roll back to").click()
    enter_key(page, served.keys["reader"])
    refusal = "This request requires the scope promote; the key reader has read"
    expect(dialog.get_by_role("alert")).to_contain_text(refusal)
    tab.ignore(401)
    tab.ignore(403)


def test_the_key_is_stored_in_the_session_only(tab: Tab, served: Served) -> None:
    page = tab.open(L)
    use_key(page, served.keys["reader"])
    expect(key_button(page)).to_contain_text("✓")
    storage = "[JSON.stringify(localStorage), document.cookie, sessionStorage.getItem('key')]"
    assert page.evaluate(storage) == ["{}", "", served.keys["reader"]]
    other = page.context.new_page()
    other.goto(served.url)
    assert other.evaluate("sessionStorage.getItem('key')") is None
    key_button(page).click()
    page.get_by_role("button", name="Remove key").click()
    expect(key_button(page)).to_have_accessible_name(re.compile("not entered"))
    assert page.evaluate("sessionStorage.getItem('key')") is None


def test_one_dialog_opens_if_reading_requires_a_key(tab: Tab, served: Served) -> None:
    def locked(route: Route) -> None:
        if route.request.headers.get("authorization") == f"Bearer {served.keys['reader']}":
            route.continue_()
        else:
            route.fulfill(status=401, json={"code": "unauthenticated", "message": "this request requires an API key"})

    tab.page.route("**/v1/**", locked)
    page = tab.open(L)
    expect(page.get_by_role("dialog")).to_have_count(1)
    page.get_by_role("button", name="Cancel").click()
    expect(page.get_by_role("alert").first).to_contain_text("API key required")
    use_key(page, served.keys["reader"])
    expect_champion(page, 3)
    tab.ignore(401)


def test_an_evaluation_is_started_followed_and_stopped(tab: Tab, served: Served) -> None:
    page = tab.open(f"{L}/evaluations/new")
    page.get_by_label("script:random").check()
    page.get_by_label("@1", exact=True).check()
    page.get_by_label("Blocks per pair").fill("20000")
    page.get_by_label("Reason").fill(HOSTILE)
    page.get_by_role("button", name="Start").click()
    enter_key(page, served.keys["evaluator"])
    expect(page.get_by_role("heading", level=2, name=re.compile(r"Evaluation \d+"))).to_be_visible()
    expect(page.locator("section")).to_contain_text("running", timeout=SLOW)
    bar = page.get_by_role("progressbar", name="Matches played")
    for _ in range(2):  # it follows the matches
        value = bar.get_attribute("value", timeout=SLOW)
        expect(bar).not_to_have_attribute("value", str(value), timeout=SLOW)
    expect(page.locator("section")).to_contain_text(HOSTILE)
    page.get_by_role("button", name="Stop …").click()
    page.get_by_role("dialog").get_by_role("button", name="Stop", exact=True).click()
    expect(page.get_by_role("status").filter(has_text="stopped")).to_be_visible(timeout=SLOW)
    expect(page.get_by_role("button", name="Stop …")).to_have_count(0)
    tab.ignore(401)
    assert served.registry.evaluations.newest(LEAGUE)[0].state == "stopped"


def test_a_completed_evaluation_shows_its_leaderboard(tab: Tab, served: Served) -> None:
    page = tab.open(f"{L}/evaluations/new")
    use_key(page, served.keys["everything"])
    page.get_by_label("script:random").check()
    page.get_by_label("@2", exact=True).check()
    page.get_by_label("Blocks per pair").fill("3")
    page.get_by_label("Seed").fill("5")
    page.get_by_role("button", name="Start").click()
    table = page.get_by_role("table", name="Leaderboard")
    expect(table).to_contain_text(f"{LEAGUE}@2", timeout=SLOW)
    expect(page.locator("section")).to_contain_text("18 games")
    page.get_by_role("link", name="Evaluations").first.click()
    newest = page.get_by_role("table", name="Evaluations, newest first").locator("tbody tr").first
    expect(newest).to_contain_text("✓ done")


def test_an_invalid_evaluation_shows_an_error(tab: Tab, served: Served) -> None:
    page = tab.open(f"/leagues/{EMPTY}/evaluations/new")
    use_key(page, served.keys["everything"])
    expect(page.get_by_label("script:random")).to_be_visible()
    expect(page.get_by_label("script:one_ply")).to_have_count(0)  # it does not know this game
    page.get_by_label("Seed").fill(str(2**63))
    page.get_by_role("button", name="Start").click()
    expect(page.locator("main").get_by_role("alert")).to_contain_text("Seed: Input should be less than")
    tab.ignore(400)


def test_metrics_of_a_run_are_updated_live(tab: Tab, served: Served) -> None:
    page = tab.open(f"{L}/runs/{RUN}")
    run = page.locator("section").first
    expect(page.locator("canvas").first).to_be_visible()
    expect(run).to_contain_text("20,000 of 40,000")
    expect(run).to_contain_text("7 of 10")
    expect(run).to_contain_text("75 %")  # of the time budget; the step budget is at 50 %
    record(served.registry, 21_000)
    expect(run).to_contain_text("21,000 of 40,000")
    expect(page.get_by_role("img", name=re.compile("^return over 21,000 steps"))).to_be_visible()
    page.get_by_role("button", name="Show all metrics").click()
    expect(page.get_by_role("heading", name="seconds per iteration")).to_be_visible()


def test_hostile_text_is_not_interpreted(tab: Tab, served: Served) -> None:
    tab.page.on("dialog", lambda dialog: tab.errors.append(f"a dialog was opened: {dialog.message}"))
    texts = {L: f"{LEAGUE}@3", f"{L}/evaluations": "Evaluations"}
    texts |= dict.fromkeys((f"{L}/versions", f"{L}/history", f"{L}/traffic", f"{L}/runs/{RUN}"), HOSTILE)
    for path, text in texts.items():
        page = tab.open(path)
        expect(page.locator("main")).to_contain_text(text)
        expect_finished(page)
        expect(page.locator("img:not(.brand img, .picture img), section script")).to_have_count(0)
    for name in ("<img src=x onerror=alert(1)>", "'\"><b>", "..%2F..", "%00"):
        page = tab.open(f"/leagues/{name.replace('/', '%2F') if '%' not in name else name}")
        expect(page.get_by_role("heading", level=1)).to_contain_text("not found")
        expect(page.locator("main b, main img")).to_have_count(0)
    tab.ignore(400)
    tab.ignore(404)


def test_a_note_is_added_edited_and_deleted(tab: Tab, served: Served) -> None:
    page = tab.open(f"{L}/versions")
    row = page.get_by_role("row").filter(has=page.get_by_role("button", name=f"Promote {LEAGUE}@1"))
    row.get_by_role("button", name=f"Add a note to {LEAGUE}@1").click()
    dialog = page.get_by_role("dialog", name=f"Note of {LEAGUE}@1")
    dialog.get_by_label("Note").fill("twice the entropy")
    dialog.get_by_role("button", name="Save").click()
    enter_key(page, served.keys["everything"])
    expect(row).to_contain_text("twice the entropy")
    tab.ignore(401)
    served.registry.versions.set_note(CheckpointRef(LEAGUE, 1), "half the entropy", actor="cli")
    expect(row).to_contain_text("half the entropy")
    row.get_by_role("button", name=f"Edit the note of {LEAGUE}@1").click()
    expect(dialog.get_by_label("Note")).to_have_value("half the entropy")
    dialog.get_by_label("Note").fill("")
    dialog.get_by_role("button", name="Save").click()
    expect(row.get_by_role("button", name=f"Add a note to {LEAGUE}@1")).to_be_visible()
    assert served.registry.versions.get(LEAGUE, 1).note is None


def test_the_champion_at_a_given_time(tab: Tab, served: Served) -> None:
    page = tab.open(f"{L}/history")
    time = page.get_by_label("Look up champion at")
    time.fill("2020-03-03T14:00")
    expect(page.locator(".lookup")).to_contain_text("No version had the alias at that time")
    time.fill("2100-03-03T14:00")
    expect(page.locator(".lookup")).to_contain_text(f"{LEAGUE}@3")


def test_a_page_recovers_with_the_server_without_user_action(tab: Tab) -> None:
    shorten(tab.page, "data.js", "RETRY_DELAY")
    page = tab.open(L)
    expect_champion(page, 3)
    tab.page.route("**/v1/**/leaderboard*", lambda route: route.abort())
    page.goto(f"{tab.url}{L}")
    expect(page.get_by_role("alert").first).to_contain_text("The server is not responding")
    tab.page.unroute("**/v1/**/leaderboard*")
    expect_champion(page, 3)
    expect(page.get_by_role("alert")).to_have_count(0)
    tab.errors = [error for error in tab.errors if "net::ERR_FAILED" not in error]


LIVE_PAGES = ("/", L, f"{L}/runs/{RUN}", f"/leagues/{CONNECT_FOUR}/play")


def test_each_open_page_says_that_the_server_is_not_responding(tab: Tab, served: Served, tmp_path: Path) -> None:
    with proxy(tmp_path, served.url) as server:
        pages = [tab.page, *(tab.page.context.new_page() for _ in LIVE_PAGES[1:])]
        for page, path in zip(pages, LIVE_PAGES, strict=True):
            page.goto(server.url + path)
            expect(page.locator("main")).to_contain_text(re.compile("Games|Start game"))
        expect_champion(pages[1], 3)

        def expect_notices(number: int) -> None:
            for page in pages:
                expect(page.get_by_role("alert")).to_have_count(number)
                expect(page.get_by_role("banner").get_by_text("The server is not responding")).to_have_count(number)

        expect_notices(0)
        server.freeze()
        expect_notices(1)
        server.thaw()
        expect_notices(0)
        server.stop()
        expect_notices(1)
        served.registry.aliases.set(LEAGUE, "champion", 2, expected=3, actor="cli", reason="nobody is watching")
        server.start()
        expect_notices(0)
        expect_champion(pages[1], 2)
    tab.errors = [error for error in tab.errors if "net::ERR_" not in error]


def test_an_open_event_stream_does_not_hide_that_requests_fail(tab: Tab) -> None:
    page = tab.open(L)
    expect_champion(page, 3)
    page.context.set_offline(True)  # connections that are open stay open
    expect(page.get_by_role("banner").get_by_text("The server is not responding")).to_be_visible()
    page.context.set_offline(False)
    expect(page.get_by_role("alert")).to_have_count(0)
    tab.errors = [error for error in tab.errors if "net::ERR_" not in error]


def test_an_invalid_key_is_rejected(tab: Tab, served: Served) -> None:
    page = tab.open(L)
    button = key_button(page)
    button.click()
    submit_key(page, "plk_wrong")
    expect(key_dialog(page).get_by_role("alert")).to_contain_text("The API key is unknown, revoked or expired")
    enter_key(page, served.keys["reader"])
    expect(button).to_have_accessible_name(re.compile("✓.*, valid"))
    page.evaluate("sessionStorage.setItem('key', 'plk_revoked')")
    page.reload()
    page.get_by_role("button", name="Cancel").click()
    expect(button).to_have_accessible_name(re.compile("✗.*, not valid"))
    tab.ignore(401)


def test_results_that_are_being_computed_are_not_called_missing(tab: Tab) -> None:
    shorten(tab.page, "league.js", "REFRESH_INTERVAL")
    page = tab.open(f"/leagues/{NAMED}")
    expect(page.get_by_text("No games yet")).to_be_visible()

    def change(route: Route) -> None:
        reply = route.fetch()
        route.fulfill(response=reply, json=reply.json() | {"up_to_date": False})

    tab.page.route(re.compile(f"/v1/leagues/{NAMED}$"), change)
    expect(page.get_by_text("updating", exact=True)).to_be_visible()  # without a reload
    expect(page.get_by_text("The leaderboard has not been computed yet")).to_be_visible()
    page.get_by_role("link", name="Payoff matrix").click()
    expect(page.get_by_text("The payoff matrix has not been computed yet")).to_be_visible()


def test_the_word_updating_is_not_broken(tab: Tab) -> None:
    """At every width, as a line of its own if it does not fit."""

    def change(route: Route) -> None:
        reply = route.fetch()
        route.fulfill(response=reply, json=reply.json() | {"up_to_date": False})

    tab.page.route(re.compile(f"/v1{L}$"), change)
    page = tab.open(L)
    word = page.get_by_text("updating", exact=True)
    expect(word).to_be_visible()
    for width in range(320, 1500, 20):
        resize(page, width)
        box = word.bounding_box()
        assert box is not None
        assert box["height"] < 30, f"two lines at {width} pixels"


def test_a_request_without_a_response_is_repeated(tab: Tab) -> None:
    lost = iter([True])

    def lose_one(route: Route) -> None:
        if not next(lost, False):
            route.continue_()

    tab.page.route(f"**/v1{L}", lose_one)
    expect_champion(tab.open(L), 3)
    assert next(lost, None) is None


def test_requests_are_retried_while_the_server_is_busy(tab: Tab) -> None:
    answers = iter([503, 429])

    def busy(route: Route) -> None:
        status = next(answers, None)
        if status is None:
            route.continue_()
        else:
            route.fulfill(status=status, json={"code": "not_ready", "message": "not yet"}, headers={"retry-after": "1"})

    tab.page.route("**/v1/**/leaderboard*", busy)
    page = tab.open(L)
    expect_champion(page, 3)
    expect(page.get_by_role("alert")).to_have_count(0)
    tab.ignore(503)
    tab.ignore(429)
