"""Games of the ledger are watched, and games against policies are played."""

import re
from pathlib import Path

import pytest
from PIL import Image
from playwright.sync_api import Page, expect

from tests.browser.conftest import Served, Tab
from tests.browser.leagues import CONNECT_FOUR, answer, verdict_between_versions
from tests.evaluation.examples import LEAGUE

TURN = re.compile("Your turn")


def game_of(served: Served) -> str:
    """The page of a game between two versions."""
    return f"/leagues/{LEAGUE}/matches/{verdict_between_versions(served.registry).schedule}/0/0"


def test_a_game_is_watched_step_by_step(tab: Tab, served: Served) -> None:
    page = tab.open(game_of(served))
    told, place = page.locator(".told"), page.locator(".seek output")
    expect(place).to_have_text(re.compile("0 of"))
    expect(page.locator(".picture img")).to_be_visible()
    first = page.locator(".picture img").get_attribute("src")
    page.get_by_role("button", name="One step on").click()
    expect(told).to_contain_text("random opening")
    expect(page.locator(".picture img")).not_to_have_attribute("src", str(first))
    page.keyboard.press("End")
    expect(told).to_contain_text("· end")
    expect(told).to_contain_text("return")
    expect(told.get_by_role("list", name="Probabilities")).to_contain_text("%")
    page.keyboard.press("ArrowLeft")
    expect(told).not_to_contain_text("· end")
    page.reload()
    expect(place).not_to_have_text(re.compile("^0 of"))  # the address knows the step
    page.keyboard.press("Home")
    expect(told).to_contain_text("Start")


def test_a_game_plays_by_itself_and_is_sought(tab: Tab, served: Served) -> None:
    page = tab.open(game_of(served))
    expect(page.locator(".picture img")).to_be_visible()
    page.get_by_label("Speed").select_option("8")
    page.get_by_role("button", name="Play").click()
    expect(page.locator(".told")).to_contain_text("· end")
    expect(page.get_by_role("button", name="Play")).to_be_visible()
    page.get_by_role("slider", name="Step").fill("3")
    expect(page.locator(".told")).to_contain_text("Step 3")


def test_a_game_is_taken_home_as_a_gif(tab: Tab, served: Served, tmp_path: Path) -> None:
    page = tab.open(game_of(served))
    with page.expect_download(timeout=60_000) as download:
        page.get_by_role("button", name="Download GIF").click()
    download.value.save_as(tmp_path / "game.gif")
    with Image.open(tmp_path / "game.gif") as film:
        assert (film.format, film.n_frames > 3) == ("GIF", True)


def found(served: Served, opponent: str, score: float) -> tuple[int, list[int]]:
    """A seed, and actions with which a game against a script ends so: always the first column of those preferred."""
    for seed in range(60):
        actions: list[int] = []
        while True:
            asked = {"opponent": opponent, "agent": "player_0", "seed": seed, "actions": actions}
            state = answer("POST", f"{served.url}/v1/leagues/{CONNECT_FOUR}/play", asked)
            if state["over"]:
                break
            actions.append(next(column for column in (3, 4, 2, 5, 1, 6, 0) if column in state["legal"]))
        if state["score"] == score:
            return seed, actions
    raise AssertionError(f"no game against {opponent} ends with {score}")


def begin(page: Page, opponent: str, seat: str, seed: int) -> None:
    page.get_by_label("Against").select_option(opponent)
    page.get_by_label("Your seat").select_option(seat)
    page.get_by_label("Seed").fill(str(seed))
    page.get_by_role("button", name="Begin").click()


@pytest.mark.parametrize(
    ("opponent", "score", "words"), [("script:random", 1, "You have won"), ("script:one_ply", 0, "You have lost")]
)
def test_a_whole_game_of_connect_four_is_played_by_clicks(
    tab: Tab, served: Served, opponent: str, score: float, words: str
) -> None:
    seed, actions = found(served, opponent, score)
    page = tab.open(f"/leagues/{CONNECT_FOUR}/play")
    begin(page, opponent, "player_0", seed)
    turn = page.locator(".turn")
    for played, action in enumerate(actions):
        expect(turn).to_have_text(TURN)
        if played == 2:
            page.reload()  # the address holds the game
            expect(turn).to_have_text(TURN)
        if played % 2:
            page.get_by_role("group", name="Your actions").get_by_role("button", name=str(action), exact=True).click()
        else:
            page.locator(f".places button[data-action='{action}']").click()
    expect(turn).to_contain_text(words)
    assert f"actions={'%2C'.join(map(str, actions))}" in page.url
    page.get_by_role("button", name="Take back").click()
    expect(turn).to_have_text(TURN)


def test_a_game_against_the_champion_by_keys_with_its_probabilities(tab: Tab) -> None:
    page = tab.open(f"/leagues/{LEAGUE}/play")
    begin(page, f"{LEAGUE}@champion", "player_1", 3)
    turn = page.locator(".turn")
    expect(turn).to_have_text(TURN)
    expect(page.locator(".told")).to_contain_text(f"{LEAGUE}@3")  # pinned: a promotion would not change the game
    page.get_by_label("Show the policy's probabilities").check()
    expect(page.get_by_role("list", name="Probabilities").first).to_contain_text("%")
    expect(turn).to_have_text(TURN)
    legal = page.get_by_role("group", name="Your actions").locator("button[aria-disabled='false']").first
    page.keyboard.press(legal.inner_text().strip())
    expect(turn).to_have_text(re.compile("Your turn|You have|A draw"))
    expect(page).to_have_url(re.compile(r"actions=\d"))
    page.get_by_role("button", name="Other opponent").click()
    expect(page.get_by_role("button", name="Begin")).to_be_visible()


def test_what_is_not_legal_is_not_played(tab: Tab) -> None:
    page = tab.open(f"/leagues/{LEAGUE}/play#opponent=script:random&agent=player_1&seed=1&actions=4")
    expect(page.locator(".turn")).to_have_text(TURN)
    before = page.url
    page.get_by_role("group", name="Your actions").locator("button.illegal").first.click(force=True)
    assert page.url == before
    page.goto(f"{tab.url}/leagues/{LEAGUE}/play#opponent=script:random&agent=player_1&seed=1&actions=99")
    page.reload()
    expect(page.get_by_role("alert")).to_contain_text("99")
    tab.forgive(422)
    tab.forgive(400)
