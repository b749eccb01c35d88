"""A report, opened as a file without any network: contents, games, accessibility, themes, size, hostile text."""

import re
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, expect

from evaluation.documents import Difference
from league.registry.registry import Registry
from policy_league.cli.evaluation.report_contents import MOST_BYTES, MOST_VERDICTS, league_report, report_file
from tests.support.clients.browsers import TIMEOUT, expect_finished, expect_fits, resize, serious
from tests.support.leagues import reported_league
from tests.support.leagues.tictactoe import LEAGUE
from tests.support.reports import exploitability_report
from tests.support.waiting import until

pytestmark = pytest.mark.slow  # a browser takes all cores

BASE = f"/v1/leagues/{LEAGUE}"
TABS = ["Leaderboard", "Payoff matrix", "Upsets", "Versions", "Verdicts", "History"]
Open = Callable[[dict[str, Any]], Page]


def report_of(registry: Registry) -> dict[str, Any]:
    """The report of the league, made in a thread of its own: Playwright has an event loop in this one."""
    with ThreadPoolExecutor(1) as threads:
        return threads.submit(league_report, registry, LEAGUE).result()


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    with reported_league.league_after_nightly(tmp_path_factory.mktemp("home")) as registry:
        return report_of(registry)


@pytest.fixture
def opened(browser: Browser, tmp_path: Path) -> Iterator[Open]:
    """Opens a report in a new session."""
    context = browser.new_context(viewport={"width": 1180, "height": 800})
    context.set_offline(True)
    context.set_default_timeout(TIMEOUT)
    problems: list[str] = []
    requests: list[str] = []

    def open_file(contents: dict[str, Any]) -> Page:
        (tmp_path / "report.html").write_bytes(report_file(contents))
        page = context.new_page()
        page.on("console", lambda message: problems.append(message.text))
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on("dialog", lambda dialog: problems.append(dialog.message))
        page.on("request", lambda made: requests.append(made.url))
        page.goto((tmp_path / "report.html").as_uri())
        return page

    yield open_file
    context.close()
    assert problems == []
    assert [url for url in requests if not url.startswith(("data:", tmp_path.as_uri()))] == []


def select(page: Page, tab: str) -> Page:
    page.get_by_role("navigation", name=f"Pages of {LEAGUE}").get_by_role("link", name=tab, exact=True).click()
    expect(page.get_by_role("heading", level=2, name=tab, exact=True)).to_be_visible()
    expect_finished(page)
    return page


@pytest.mark.e2e
def test_all_results_are_on_its_pages(opened: Open, report: dict[str, Any]) -> None:
    page = opened(report)
    expect(page.get_by_role("heading", level=1)).to_have_text(LEAGUE)
    tabs = page.get_by_role("navigation", name=f"Pages of {LEAGUE}").get_by_role("link")
    expect(tabs).to_have_text(TABS)
    for tab, words in (
        ("Leaderboard", r"tictactoe@3\s*★\s*champion.*script:random"),
        ("Payoff matrix", r"always wins.*α-Rank.*Nash.*Against Nash"),
        ("Upsets", r"Did better than.*Expected score"),
        ("Versions", r"tictactoe@3.*became champion|became champion.*tictactoe@3"),
        ("Verdicts", r"@3\s*@2\s*▲ promote"),
        ("History", r"rolled back.*as it was.*promoted by the gate"),
    ):
        select(page, tab)
        expect(page.locator("main")).to_contain_text(re.compile(words, re.DOTALL))
        assert serious(page) == []
        for offer in ("Promote …", "Roll back …", "Edit …", "API key", "Start an evaluation"):
            expect(page.get_by_text(offer)).to_have_count(0)
    resize(page, 360)
    for tab in TABS:
        expect_fits(select(page, tab))


def test_every_link_leads_to_a_page_of_the_report(opened: Open, report: dict[str, Any]) -> None:
    page = opened(report)
    waiting = visited = {""}
    while waiting:
        address, *remaining = waiting
        page.evaluate("hash => { location.hash = hash }", address)
        page.reload()  # the page before would satisfy what follows
        expect_finished(page)
        expect(page.locator("main section")).to_be_visible()
        expect(page.locator("main")).not_to_contain_text(re.compile("does not contain|not found"))
        links = set(page.locator("a:not(.skip-link)").evaluate_all("links => links.map(link => link.hash)"))
        waiting, visited = {*remaining, *links - visited}, visited | links
    assert len(visited) > 15


def test_the_address_and_the_history_of_the_browser_select_pages(opened: Open, report: dict[str, Any]) -> None:
    page = select(opened(report), "Verdicts")
    page.get_by_role("row", name=re.compile("@3 @2")).get_by_role("link").click()
    expect(page.get_by_text("Stronger: ")).to_be_visible()
    expect(page).to_have_url(re.compile(r"/verdicts/[^/]+$"))
    address = page.url
    page.go_back()
    expect(page.get_by_role("heading", level=2)).to_have_text("Verdicts")
    page.goto(address)
    page.reload()
    expect(page.get_by_text("Stronger: ")).to_be_visible()
    expect(page.locator("canvas")).to_be_visible()
    expect(page).to_have_title(f"@3 against @2 · {LEAGUE} · Policy League")


def test_an_upset_is_shown_step_by_step(opened: Open, report: dict[str, Any]) -> None:
    upset = report["documents"][BASE]["summary"]["upsets"][0]
    recording = report["documents"][f"{BASE}/matches/{upset['match']}/games/{upset['game']}"]
    page = select(opened(report), "Upsets")
    page.get_by_role("link", name=f"Game {upset['game']} of match {upset['match']}").click()
    expect(page.get_by_text(f"0 of {recording['length']}")).to_be_visible()
    for step in recording["steps"][1:]:
        page.get_by_role("button", name="Next step").click()
        image = page.locator(".picture img")
        expect(image).to_have_attribute("src", step["picture"])
        (move,) = step["moves"]
        expect(page.locator(".moves")).to_contain_text(re.compile(rf"{move['agent']}.*plays\s*{move['action']}"))
    expect(page).to_have_url(re.compile(rf"#{recording['length']}$"))
    page.reload()
    expect(page.get_by_text(f"{recording['length']} of {recording['length']}")).to_be_visible()


def test_a_game_with_some_of_its_steps(opened: Open, report: dict[str, Any]) -> None:
    contents = deepcopy(report)
    upset = contents["documents"][BASE]["summary"]["upsets"][0]
    recording = contents["documents"][f"{BASE}/matches/{upset['match']}/games/{upset['game']}"]
    last = recording["length"]
    recording["every"] = 2
    recording["steps"] = [step for step in recording["steps"] if step["step"] % 2 == 0 or step["step"] == last]
    page = select(opened(contents), "Upsets")
    page.get_by_role("link", name=f"Game {upset['game']} of match {upset['match']}").click()
    expect(page.get_by_text("One in 2 steps is shown.")).to_be_visible()
    numbers = [step["step"] for step in recording["steps"]]
    for key, order in (("ArrowRight", numbers[1:]), ("ArrowLeft", numbers[-2::-1])):
        for number in order:
            page.keyboard.press(key)
            expect(page.get_by_text(f"{number} of {last}")).to_be_visible()
            expect(page.locator(".moves, .game-info .muted").first).to_be_visible()


def test_a_game_that_cannot_be_replayed_has_a_reason(opened: Open, report: dict[str, Any]) -> None:
    contents = deepcopy(report)
    upset = contents["documents"][BASE]["summary"]["upsets"][0]
    error = {"code": "game_crashed", "message": "the environment is broken"}
    contents["documents"][f"{BASE}/matches/{upset['match']}/games/{upset['game']}"] = error
    page = select(opened(contents), "Upsets")
    page.get_by_role("link", name=f"Game {upset['game']} of match {upset['match']}").click()
    expect(page.get_by_role("alert")).to_contain_text("The environment is broken.")


@pytest.mark.parametrize("exploiters", [2, 1])
def test_further_evidence_of_a_verdict(opened: Open, report: dict[str, Any], exploiters: int) -> None:
    contents = deepcopy(report)
    newest = contents["documents"][f"{BASE}/verdicts"]["verdicts"][0]["verdict"]
    test = exploitability_report(exploiters)
    confirmation = {"verdict": newest, "candidate": "a@2", "opponent": "a@1", "games": 400, "score": 0.544, "elo": 31.0}
    confirmation |= {"interval": [None, 59.0], "difference": Difference(1.5, 0.5, 2.5).to_json()}
    more = {"exploitability": test.to_json(), "confirmation": confirmation, "alpha": 0.05 / 365}
    contents["documents"][f"{BASE}/verdicts/{newest}"] |= more
    page = select(opened(contents), "Verdicts")
    page.locator("tbody th a").first.click()
    main = page.locator("main")
    expect(main).to_contain_text(re.compile(rf"{re.escape(test.finding)}.*−3\.00", re.S))
    expect(main).to_contain_text("A best response to tictactoe@2 scores at least 40.0 %.")
    comparison = "; for others that are trained in the same way: +0.100 0.010 to 0.190"
    expect(main).to_contain_text(f"The 95 % interval is for these exploiters{comparison if exploiters > 1 else ''}.")
    expect(main).to_contain_text("score 54.4 %, +31 Elo, 95 % interval −∞ to +59.")
    expect(main).to_contain_text("0.014 %")


def test_a_league_without_results_has_a_report(opened: Open, tmp_path: Path) -> None:
    with reported_league.empty(tmp_path / "home") as registry:
        page = opened(report_of(registry))
    for tab, words in zip(
        TABS, ("No games", "No games", "No upsets", "No versions", "No verdicts", "No version"), strict=True
    ):
        expect(select(page, tab).locator(".empty")).to_contain_text(words)


def test_sides_have_their_leaderboards(opened: Open, tmp_path: Path) -> None:
    with reported_league.league_with_roles(tmp_path / "home") as registry:
        page = opened(report_of(registry))
    page.get_by_role("link", name="adversary").click()
    expect(page.get_by_role("row", name=re.compile("script:random .* 10$"))).to_be_visible()


def test_it_is_printed_in_light_colours_without_navigation(opened: Open, report: dict[str, Any]) -> None:
    page = opened(report)
    background = "getComputedStyle(document.body).backgroundColor"
    light = page.evaluate(background)
    theme = page.get_by_role("button", name="Theme")
    theme.click()
    theme.click()
    expect(theme).to_have_accessible_name("Theme: dark")
    assert page.evaluate(background) != light
    page.emulate_media(media="print")
    until(lambda: page.evaluate(background) == light)
    expect(page.locator(".tabs")).to_be_hidden()
    expect(page.locator(".header")).to_be_hidden()
    expect(page.get_by_role("row", name=re.compile("tictactoe@3"))).to_be_visible()


def test_hostile_text_is_shown_as_text(opened: Open, report: dict[str, Any]) -> None:
    page = select(opened(report), "History")
    expect(page.get_by_role("cell", name=reported_league.HOSTILE, exact=True)).to_have_count(2)


def test_the_size_of_a_report_of_500_versions_is_limited(opened: Open, report: dict[str, Any]) -> None:
    contents = deepcopy(report)
    documents = contents["documents"]

    def repeated(path: str, rows: str, key: str, value: Callable[[int], Any] = lambda number: number) -> None:
        first = documents[f"{BASE}{path}"][rows][0]
        documents[f"{BASE}{path}"][rows] = [first | {key: value(number)} for number in range(500, 0, -1)]

    repeated("/leaderboard", "leaderboard", "ref", lambda number: f"{LEAGUE}@{number}")
    repeated("/versions", "versions", "version")
    repeated("/ratings", "versions", "number", lambda number: 501 - number)
    repeated("/aliases/champion/history", "history", "event")
    judgement = documents[f"{BASE}/verdicts/{documents[f'{BASE}/verdicts']['verdicts'][0]['verdict']}"]
    curve = [[block, -1.234567890123456] for block in range(400)]
    repeated("/verdicts", "verdicts", "verdict", lambda number: f"{LEAGUE}-verdict-{number:016x}")
    for row in documents[f"{BASE}/verdicts"]["verdicts"][:MOST_VERDICTS]:
        documents[f"{BASE}/verdicts/{row['verdict']}"] = judgement | {"curve": curve}
    names = [f"{LEAGUE}@{number}" for number in range(500, 460, -1)]
    difference = Difference(1.234567890123456, 0.234567890123456, 2.34567890123456).to_json()
    payoff = documents[f"{BASE}/payoff"]["payoff"]
    payoff |= {"contestants": names, "score": [[0.123456789] * 40] * 40, "games": [[1234] * 40] * 40}
    payoff |= {"difference": [[difference] * 40] * 40, "by_side": dict.fromkeys(payoff["by_side"], payoff["score"])}
    documents[f"{BASE}/matches/images"] = "A" * MOST_BYTES
    assert 5_000_000 < len(report_file(contents)) < 10_000_000
    page = opened(contents)
    expect(page.locator("tbody tr")).to_have_count(500)
    expect(select(page, "Versions").locator("tbody tr")).to_have_count(500)
