"""What people change, and what changes before their eyes: promotions, evaluations, keys."""

import re

from playwright.sync_api import Page, Route, expect

from league.refs import CheckpointRef
from tests.browser.conftest import Served, Tab
from tests.browser.leagues import EMPTY, RUN, record
from tests.evaluation.examples import LEAGUE
from tests.evaluation.pages.leagues import HOSTILE

L = f"/leagues/{LEAGUE}"
KEY_DIALOG = "API key"


def enter_key(page: Page, key: str) -> None:
    page.get_by_role("dialog", name=KEY_DIALOG).get_by_label("Key", exact=True).fill(key)
    page.get_by_role("button", name="Use this key").click()


def leader(page: Page, version: int) -> None:
    """The leaderboard says who is champion."""
    row = page.get_by_role("row").filter(has_text="★")
    expect(row).to_have_count(1)
    expect(row).to_contain_text(f"{LEAGUE}@{version}")


def test_a_promotion_and_a_rollback_change_the_leaderboard_without_reload(tab: Tab, served: Served) -> None:
    page = tab.open(L)
    page.evaluate("window.isTheSame = true")
    leader(page, 3)
    page.get_by_role("button", name="Promote …").click()
    dialog = page.get_by_role("dialog", name=f"Promote a version of {LEAGUE}")
    dialog.get_by_label("Version").select_option("2")
    expect(dialog).to_contain_text(f"{LEAGUE}@2 becomes the champion instead of {LEAGUE}@3")
    dialog.get_by_label("Reason").fill(HOSTILE)
    dialog.get_by_role("button", name="Promote @2").click()
    enter_key(page, served.keys["everything"])
    leader(page, 2)
    tab.forgive(401)
    event = served.registry.history(LEAGUE)[0]
    assert (event.version, event.previous, event.actor, event.reason) == (2, 3, "everything", HOSTILE)

    page.get_by_role("button", name="Roll back …").click()
    dialog = page.get_by_role("dialog", name=f"Roll {LEAGUE} back")
    expect(dialog).to_contain_text(f"{LEAGUE}@3 becomes the champion again, instead of {LEAGUE}@2")
    dialog.get_by_label("Reason").fill("it was a try")
    dialog.get_by_role("button", name="Roll back to @3").click()
    leader(page, 3)
    assert page.evaluate("window.isTheSame"), "the page was not loaded again"


def test_what_a_key_may_not_do_is_not_offered(tab: Tab, served: Served) -> None:
    page = tab.open(f"{L}/versions")
    expect(page.get_by_role("button", name=f"Promote {LEAGUE}@1")).to_be_enabled()
    page.get_by_role("button", name=re.compile("^Key")).click()
    enter_key(page, served.keys["evaluator"])
    for name in ("Promote …", "Roll back …", f"Promote {LEAGUE}@1"):
        expect(page.get_by_role("button", name=name, exact=True)).to_be_disabled()
    expect(page.get_by_title(f"The key evaluator may not promote in {LEAGUE}.").first).to_be_visible()
    page.get_by_role("button", name=re.compile("^Key")).click()
    enter_key(page, served.keys["reader"])
    page.get_by_role("link", name="Evaluations").click()
    expect(page.get_by_text(f"The key reader may not evaluate in {LEAGUE}.")).to_be_visible()
    expect(page.get_by_role("link", name="Start one …")).to_have_count(0)


def test_a_promotion_by_others_is_seen(tab: Tab, served: Served) -> None:
    page = tab.open(L)
    leader(page, 3)
    served.registry.set_alias(LEAGUE, "champion", 1, expected=3, actor="cli", reason="from elsewhere")
    leader(page, 1)
    served.registry.rollback(LEAGUE, actor="cli", reason="from elsewhere")
    leader(page, 3)


def test_a_champion_that_moved_meanwhile_is_not_replaced(tab: Tab, served: Served) -> None:
    page = tab.open(f"{L}/versions")
    page.get_by_role("button", name=re.compile("^Key")).click()
    enter_key(page, served.keys["everything"])
    page.get_by_role("button", name=f"Promote {LEAGUE}@1").click()
    dialog = page.get_by_role("dialog", name=f"Promote {LEAGUE}@1")
    served.registry.set_alias(LEAGUE, "champion", 2, expected=3, actor="cli", reason="faster")
    dialog.get_by_label("Reason").fill("slower")
    dialog.get_by_role("button", name="Promote @1").click()
    expect(dialog.get_by_role("alert")).to_contain_text("did not work")
    tab.forgive(409)
    served.registry.rollback(LEAGUE, actor="cli", reason="as it was")


def test_a_key_that_may_not_is_told_so(tab: Tab, served: Served) -> None:
    page = tab.open(L)
    page.get_by_role("button", name="Roll back …").click()
    dialog = page.get_by_role("dialog", name=f"Roll {LEAGUE} back")
    dialog.get_by_label("Reason").fill("may I?")
    dialog.get_by_role("button", name="Roll back to").click()
    enter_key(page, served.keys["reader"])
    expect(dialog.get_by_role("alert")).to_contain_text("This needs a key of scope promote: reader is for read")
    tab.forgive(401)
    tab.forgive(403)


def test_a_key_is_kept_in_the_session_alone(tab: Tab, served: Served) -> None:
    page = tab.open(L)
    page.get_by_role("button", name=re.compile("^Key")).click()
    enter_key(page, served.keys["reader"])
    expect(page.get_by_role("button", name=re.compile("^Key"))).to_contain_text("✓")
    kept = "[JSON.stringify(localStorage), document.cookie, sessionStorage.getItem('key')]"
    assert page.evaluate(kept) == ["{}", "", served.keys["reader"]]
    other = page.context.new_page()
    other.goto(served.url)
    assert other.evaluate("sessionStorage.getItem('key')") is None
    page.get_by_role("button", name=re.compile("^Key")).click()
    page.get_by_role("button", name="Forget the key").click()
    assert page.evaluate("sessionStorage.getItem('key')") is None


def test_where_looking_needs_a_key_it_is_asked_for_once(tab: Tab, served: Served) -> None:
    def locked(route: Route) -> None:
        if route.request.headers.get("authorization") == f"Bearer {served.keys['reader']}":
            route.continue_()
        else:
            route.fulfill(status=401, json={"code": "unauthenticated", "message": "this needs an API key"})

    tab.page.route("**/v1/**", locked)
    page = tab.open(L)
    expect(page.get_by_role("dialog")).to_have_count(1)
    page.get_by_role("button", name="Cancel").click()
    expect(page.get_by_role("alert").first).to_contain_text("A key is needed")
    page.get_by_role("button", name=re.compile("^Key")).click()
    enter_key(page, served.keys["reader"])
    leader(page, 3)
    tab.forgive(401)


def test_an_evaluation_is_started_watched_and_stopped(tab: Tab, served: Served) -> None:
    page = tab.open(f"{L}/evaluations/new")
    page.get_by_label("script:random").check()
    page.get_by_label("@1", exact=True).check()
    page.get_by_label("Blocks of each pair").fill("20000")
    page.get_by_label("Reason").fill(HOSTILE)
    page.get_by_role("button", name="Start").click()
    enter_key(page, served.keys["evaluator"])
    expect(page.get_by_role("heading", level=2)).to_have_text(re.compile(r"Evaluation \d+"))
    expect(page.locator("section")).to_contain_text("running", timeout=60_000)
    bar = page.get_by_role("progressbar", name="Matches played")
    expect(bar).not_to_have_attribute("value", "0", timeout=60_000)
    seen = bar.get_attribute("value")
    expect(bar).not_to_have_attribute("value", str(seen), timeout=60_000)
    expect(page.locator("section")).to_contain_text(HOSTILE)
    page.get_by_role("button", name="Stop …").click()
    page.get_by_role("button", name="Stop it").click()
    expect(page.get_by_role("status").filter(has_text="stopped")).to_be_visible(timeout=60_000)
    expect(page.get_by_role("button", name="Stop …")).to_have_count(0)
    tab.forgive(401)
    assert served.registry.evaluations(LEAGUE)[0].state == "stopped"


def test_an_evaluation_that_ends_shows_its_standings(tab: Tab, served: Served) -> None:
    page = tab.open(f"{L}/evaluations/new")
    page.get_by_role("button", name=re.compile("^Key")).click()
    enter_key(page, served.keys["everything"])
    page.get_by_label("script:random").check()
    page.get_by_label("@2", exact=True).check()
    page.get_by_label("Blocks of each pair").fill("3")
    page.get_by_label("Seed").fill("5")
    page.get_by_role("button", name="Start").click()
    table = page.get_by_role("table", name="Standings")
    expect(table).to_contain_text(f"{LEAGUE}@2", timeout=90_000)
    expect(page.locator("section")).to_contain_text("18 games")
    page.get_by_role("link", name="Evaluations").first.click()
    expect(page.get_by_role("table", name="Evaluations, newest first")).to_contain_text("✓ done")


def test_what_cannot_be_evaluated_is_refused_in_words(tab: Tab, served: Served) -> None:
    page = tab.open(f"/leagues/{EMPTY}/evaluations/new")
    page.get_by_role("button", name=re.compile("^Key")).click()
    enter_key(page, served.keys["everything"])
    page.get_by_label("script:one_ply").check()
    page.get_by_role("button", name="Start").click()
    expect(page.get_by_role("alert")).to_contain_text("one_ply plays connect four and tic-tac-toe only")
    tab.forgive(400)


def test_curves_grow_while_a_run_is_on(tab: Tab, served: Served) -> None:
    page = tab.open(f"{L}/runs/{RUN}")
    expect(page.locator("canvas").first).to_be_visible()
    expect(page.locator("section")).to_contain_text("20,000 of 40,000")
    expect(page.locator("section")).to_contain_text("7 of 10")
    expect(page.locator("section")).to_contain_text("75 %")  # the sooner of the two: half of its steps are done
    record(served.registry, 21_000)
    expect(page.locator("section")).to_contain_text("21,000 of 40,000")
    expect(page.get_by_role("img", name=re.compile("^return over 21,000 steps"))).to_be_visible()
    page.get_by_role("button", name="More curves").click()
    expect(page.get_by_role("heading", name="seconds of a report")).to_be_visible()


def test_hostile_words_stay_words(tab: Tab, served: Served) -> None:
    tab.page.on("dialog", lambda dialog: tab.complaints.append(f"a dialog was opened: {dialog.message}"))
    for path in (L, f"{L}/versions", f"{L}/history", f"{L}/traffic", f"{L}/evaluations", f"{L}/runs/{RUN}"):
        page = tab.open(path)
        expect(page.get_by_role("heading", level=2)).to_be_visible()
        expect(page.locator("img:not(.brand img, .picture img), section script")).to_have_count(0)
    for path in (f"{L}/versions", f"{L}/history", f"{L}/traffic"):
        expect(tab.open(path).locator("section")).to_contain_text(HOSTILE)
    for name in ("<img src=x onerror=alert(1)>", "'\"><b>", "..%2F..", "%00"):
        page = tab.open(f"/leagues/{name.replace('/', '%2F') if '%' not in name else name}")
        expect(page.get_by_role("heading", level=1)).to_contain_text("There is no")
        expect(page.locator("main b, main img")).to_have_count(0)
    tab.forgive(400)
    tab.forgive(404)


def test_a_note_is_written_seen_by_others_and_taken_away(tab: Tab, served: Served) -> None:
    page = tab.open(f"{L}/versions")
    row = page.get_by_role("row").filter(has=page.get_by_role("button", name=f"Promote {LEAGUE}@1"))
    row.get_by_role("button", name=f"Write a note of {LEAGUE}@1").click()
    dialog = page.get_by_role("dialog", name=f"Note of {LEAGUE}@1")
    dialog.get_by_label("Note").fill("twice the entropy")
    dialog.get_by_role("button", name="Keep it").click()
    enter_key(page, served.keys["everything"])
    expect(row).to_contain_text("twice the entropy")
    tab.forgive(401)
    served.registry.note(CheckpointRef(LEAGUE, 1), "half the entropy", actor="cli")
    expect(row).to_contain_text("half the entropy")
    row.get_by_role("button", name=f"Change the note of {LEAGUE}@1").click()
    expect(dialog.get_by_label("Note")).to_have_value("half the entropy")
    dialog.get_by_label("Note").fill("")
    dialog.get_by_role("button", name="Keep it").click()
    expect(row.get_by_role("button", name=f"Write a note of {LEAGUE}@1")).to_be_visible()
    assert served.registry.version(LEAGUE, 1).note is None


def test_who_was_champion_then(tab: Tab, served: Served) -> None:
    page = tab.open(f"{L}/history")
    first = served.registry.history(LEAGUE)[-1]
    asked = page.get_by_label("Who was champion at")
    local = page.evaluate(
        "at => new Date(new Date(at) - 60000 * new Date().getTimezoneOffset()).toISOString().slice(0, 16)",
        first.at.isoformat(),
    )
    asked.fill("2020-03-03T14:00")
    expect(page.locator(".then")).to_contain_text("there was none")
    asked.fill(f"2100{local[4:]}")
    expect(page.locator(".then")).to_contain_text(f"{LEAGUE}@3")


def test_a_page_that_nobody_sits_before_recovers_with_the_server(tab: Tab) -> None:
    page = tab.open(L)
    leader(page, 3)
    tab.page.route("**/v1/**/standings*", lambda route: route.abort())
    page.goto(f"{tab.url}{L}")
    expect(page.get_by_role("alert").first).to_contain_text("The server does not answer")
    tab.page.unroute("**/v1/**/standings*")
    leader(page, 3)
    expect(page.get_by_role("alert")).to_have_count(0)
    tab.complaints = [each for each in tab.complaints if "net::ERR_FAILED" not in each]


def test_a_server_that_is_busy_for_a_moment_is_asked_again(tab: Tab) -> None:
    answers = iter([503, 429])

    def busy(route: Route) -> None:
        status = next(answers, None)
        if status is None:
            route.continue_()
        else:
            route.fulfill(status=status, json={"code": "not_ready", "message": "not yet"}, headers={"retry-after": "1"})

    tab.page.route("**/v1/**/standings*", busy)
    page = tab.open(L)
    leader(page, 3)
    expect(page.get_by_role("alert")).to_have_count(0)
    tab.forgive(503)
    tab.forgive(429)
