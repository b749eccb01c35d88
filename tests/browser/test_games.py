"""Playback of recorded games, and games against policies."""

import re
from base64 import b64decode
from io import BytesIO
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageColor
from playwright.sync_api import FloatRect, Page, expect

from evaluation.playback.environment_hooks import KNOWN
from league.results.ledger import Ledger
from tests.support.clients.browsers import Served, Tab, expect_finished
from tests.support.environments.declaring import VIEWS as VIEWS_OF_AGENTS
from tests.support.leagues.browser_leagues import (
    CONNECT_FOUR,
    HIDDEN,
    NAMED,
    SEARCHED,
    TEAM,
    VIEWS,
    answer,
    verdict_between_versions,
)
from tests.support.leagues.tictactoe import LEAGUE

pytestmark = pytest.mark.slow  # a browser and a server take all cores

TURN = re.compile("Your turn")


def game_of(served: Served) -> str:
    """The path of the page of a game between two versions."""
    return f"/leagues/{LEAGUE}/matches/{verdict_between_versions(served.registry).schedule}/0/0"


def open_game(tab: Tab, league: str, agent: str) -> Page:
    """Open a game against a script, once the evaluation service has started the environment.

    Before, it may respond with 503. The page repeats the request, but the browser logs it.
    """
    answer("GET", f"{tab.url}/v1/leagues/{league}/playable")
    return tab.open(f"/leagues/{league}/play#opponent=script:first&agent={agent}&seed=1&actions=")


def test_a_game_is_played_back_step_by_step(tab: Tab, served: Served) -> None:
    page = tab.open(game_of(served))
    info, position = page.locator(".game-info"), page.locator(".seek output")
    expect(position).to_have_text(re.compile("^0 of"))
    expect(page.locator(".picture img")).to_be_visible()
    first = page.locator(".picture img").get_attribute("src")
    page.get_by_role("button", name="Next step").click()
    expect(info).to_contain_text("random opening")
    expect(page.locator(".picture img")).not_to_have_attribute("src", str(first))
    page.keyboard.press("End")
    expect(info).to_contain_text("· end")
    expect(info).to_contain_text("return")
    expect(info.get_by_role("list", name="Probabilities")).to_contain_text("%")
    page.keyboard.press("ArrowLeft")
    expect(info).not_to_contain_text("· end")
    page.reload()
    expect(position).not_to_have_text(re.compile("^0 of"))  # the step is in the address
    page.keyboard.press("Home")
    expect(info).to_contain_text("Start")


@pytest.mark.e2e
def test_a_search_version_analyses_a_recorded_game(tab: Tab, served: Served) -> None:
    matches = Ledger(served.registry).matches(league=SEARCHED)
    match = next(match for match in matches if f"{SEARCHED}@2" not in match.contestants)
    page = tab.open(f"/leagues/{SEARCHED}/matches/{match.schedule}/{match.position}/0")
    info, chart = page.locator(".game-info"), page.get_by_role("img", name=re.compile("Expected return of player_1"))
    expect(page.locator(".seek output")).to_have_text(re.compile("^0 of"))
    page.keyboard.press("End")
    expect(info).to_contain_text("· end")
    expect(chart).to_have_count(0)
    page.get_by_label("Analysis").select_option("2")
    expect(info).to_contain_text("expected return")
    expect(chart).to_be_visible()
    expect(info.get_by_role("list", name="Probabilities")).to_contain_text("%")
    page.get_by_label("Analysis").select_option(label="none")
    expect(chart).to_have_count(0)
    expect(info).not_to_contain_text("expected return")


def test_pages_show_what_a_search_costs(tab: Tab) -> None:
    """The leaderboard, and the versions, where it can be promoted."""
    searching = re.compile(r"search with @1, 40 simulations, puct, [\d.]+ ms")
    page = tab.open(f"/leagues/{SEARCHED}")
    expect(page.get_by_role("table", name="Leaderboard").get_by_role("row").filter(has_text=searching)).to_be_visible()
    page = tab.open(f"/leagues/{SEARCHED}/versions")
    version = page.get_by_role("row").filter(has_text=searching)
    expect(version.get_by_role("button", name=f"Promote {SEARCHED}@2")).to_be_visible()


def test_a_search_version_names_the_best_move(tab: Tab, served: Served) -> None:
    page = open_game(tab, SEARCHED, "player_1")
    expect(page.locator(".turn")).to_have_text(TURN)
    page.get_by_label("Analysis").select_option("2")
    expect(page.get_by_role("heading", name="Best move: ")).to_be_visible()
    expect(page.locator(".game-info")).to_contain_text("expected return")


def test_a_search_version_explains_its_own_moves(tab: Tab, served: Served) -> None:
    answer("GET", f"{tab.url}/v1/leagues/{SEARCHED}/playable")
    page = tab.open(f"/leagues/{SEARCHED}/play#opponent={SEARCHED}@2&agent=player_2&seed=1&actions=")
    expect(page.locator(".turn")).to_have_text(TURN)
    page.get_by_label("Show the policy's probabilities").check()
    move = page.locator(".move-log").get_by_role("listitem").filter(has_text="player_1 @2 plays").first
    expect(move).to_contain_text(re.compile(r"expected return [−+-]?\d"))
    expect(move.get_by_role("list", name="Probabilities")).to_contain_text("%")


AS_SOON_AS_VISIBLE = """
new MutationObserver((_, observer) => {
  if (!document.querySelector(".seek output")) return;
  observer.disconnect();
  dispatchEvent(new KeyboardEvent("keydown", { key: "End" }));
}).observe(document, { childList: true, subtree: true });
"""


def test_a_key_pressed_as_soon_as_the_game_is_visible(tab: Tab, served: Served) -> None:
    tab.page.add_init_script(AS_SOON_AS_VISIBLE)
    page = tab.open(game_of(served))
    expect(page.locator(".game-info")).to_contain_text("· end")


def test_the_address_of_an_open_game_selects_the_step(tab: Tab, served: Served) -> None:
    page = tab.open(game_of(served))
    expect(page.locator(".seek output")).to_have_text(re.compile("^0 of"))
    page.evaluate("location.hash = '#3'")
    expect(page.locator(".game-info")).to_contain_text("Step 3")
    page.goto(f"{tab.url}{game_of(served)}#2")  # of the same document
    expect(page.locator(".game-info")).to_contain_text("Step 2")
    page.get_by_role("button", name="Next step").click()
    expect(page.locator(".game-info")).to_contain_text("Step 3")
    page.evaluate("location.hash = '#99999'")
    expect(page.locator(".game-info")).to_contain_text("· end")


def test_playback_and_seeking(tab: Tab, served: Served) -> None:
    page = tab.open(game_of(served))
    expect(page.locator(".picture img")).to_be_visible()
    page.get_by_label("Speed").select_option("8")
    page.get_by_role("button", name="Play").click()
    expect(page.locator(".game-info")).to_contain_text("· end")
    expect(page.get_by_role("button", name="Play")).to_be_visible()
    page.get_by_role("slider", name="Step").fill("3")
    expect(page.locator(".game-info")).to_contain_text("Step 3")


def test_a_game_is_downloaded_as_a_gif(tab: Tab, served: Served, tmp_path: Path) -> None:
    page = tab.open(game_of(served))
    with page.expect_download(timeout=60_000) as download:
        page.get_by_role("button", name="Download GIF").click()
    download.value.save_as(tmp_path / "game.gif")
    with Image.open(tmp_path / "game.gif") as gif:
        assert (gif.format, gif.n_frames > 3) == ("GIF", True)
        frame = gif.convert("RGB")
        legend = np.array(frame.crop((10, frame.height - 70, 28, frame.height))).reshape(-1, 3).astype(int)
    for color in KNOWN["tictactoe_v3"]["agent_colors"].values():  # those of the marks in the picture
        assert abs(legend - ImageColor.getrgb(color)).sum(axis=1).min() < 30


def found(served: Served, opponent: str, score: float) -> tuple[int, list[int]]:
    """A seed and actions of a game against a script that ends with this score."""
    for seed in range(60):
        actions: list[int] = []
        while True:
            body = {"opponent": opponent, "agent": "player_0", "seed": seed, "actions": actions}
            state = answer("POST", f"{served.url}/v1/leagues/{CONNECT_FOUR}/play", body)
            if state["over"]:
                break
            actions.append(next(column for column in (3, 4, 2, 5, 1, 6, 0) if column in state["legal"]))
        if state["score"] == score:
            return seed, actions
    raise AssertionError(f"no game against {opponent} ends with {score}")


def start(page: Page, opponent: str, seat: str, seed: int) -> None:
    page.get_by_label("Opponent").select_option(opponent)
    page.get_by_label("Your agent").select_option(seat)
    page.get_by_label("Seed").fill(str(seed))
    page.get_by_role("button", name="Start game").click()


@pytest.mark.parametrize(
    ("opponent", "score", "text"),
    [
        pytest.param("script:random", 1, "You won", marks=pytest.mark.e2e),
        ("script:one_ply", 0, "You lost"),
    ],
)
def test_a_game_of_connect_four_is_played_by_clicks(
    tab: Tab, served: Served, opponent: str, score: float, text: str
) -> None:
    seed, actions = found(served, opponent, score)
    page = tab.open(f"/leagues/{CONNECT_FOUR}/play")
    start(page, opponent, "player_0", seed)
    turn = page.locator(".turn")
    for played, action in enumerate(actions):
        expect(turn).to_have_text(TURN)
        if played == 2:
            page.reload()  # the game is in the address
            expect(turn).to_have_text(TURN)
        if played % 2:
            page.get_by_role("group", name="Your actions").get_by_role("button", name=str(action), exact=True).click()
        else:
            page.locator(f".cells button[data-action='{action}']").click()
    expect(turn).to_contain_text(text)
    expect(page).to_have_url(re.compile(re.escape(f"actions={'%2C'.join(map(str, actions))}")))
    page.get_by_role("button", name="Undo move").click()
    expect(turn).to_have_text(TURN)


ACTIONS_AT = """points => points.map(
  ([x, y]) => document.elementFromPoint(x, y).closest("[data-action]")?.dataset.action ?? null
)"""


def picture_of(page: Page) -> FloatRect:
    """The place of the picture on the user's turn, once its size is known."""
    expect(page.locator(".turn")).to_have_text(TURN)
    picture = page.locator(".picture img")
    picture.evaluate("picture => picture.decode()")
    place = picture.bounding_box()
    assert place is not None
    return place


@pytest.mark.parametrize("width", [1440, 768, 390])
def test_a_click_in_a_hole_of_connect_four_takes_its_column(tab: Tab, width: int) -> None:
    tab.page.set_viewport_size({"width": width, "height": 900})
    page = open_game(tab, CONNECT_FOUR, "player_0")
    picture = picture_of(page)
    scale = picture["width"] / 99  # holes are 13 of 99 units apart, and the first is at (10.5, 10.5)
    for row, column in product(range(6), range(7)):
        x, y = picture["x"] + scale * (10.5 + 13 * column), picture["y"] + scale * (10.5 + 13 * row)
        points = [(x + right, y + down) for right, down in product((-20, 0, 20), repeat=2)]
        assert set(page.evaluate(ACTIONS_AT, points)) == {str(column)}
        button = page.get_by_role("button", name=str(column), exact=True).bounding_box()
        assert button is not None
        assert button["x"] + button["width"] / 2 == pytest.approx(x, abs=2)
    page.mouse.click(picture["x"] + scale * 10.5 + 20, picture["y"] + scale * (10.5 + 13 * 5))
    expect(page.locator(".move-log")).to_contain_text("player_0 plays 0 (you)")


def test_a_click_on_the_frame_of_the_board_is_no_move(tab: Tab) -> None:
    page = open_game(tab, CONNECT_FOUR, "player_0")
    picture = picture_of(page)
    assert page.evaluate(ACTIONS_AT, [(picture["x"] + 4, picture["y"] + picture["height"] / 2)]) == [None]


def test_a_game_against_the_champion_is_played_by_keys_with_probabilities(tab: Tab) -> None:
    page = tab.open(f"/leagues/{LEAGUE}/play")
    start(page, f"{LEAGUE}@champion", "player_1", 3)
    turn = page.locator(".turn")
    expect(turn).to_have_text(TURN)
    expect(page.locator(".game-info")).to_contain_text(f"{LEAGUE}@3")  # pinned: a promotion does not affect the game
    page.get_by_label("Show the policy's probabilities").check()
    expect(page.get_by_role("list", name="Probabilities").first).to_contain_text("%")
    expect(turn).to_have_text(TURN)
    legal = page.get_by_role("group", name="Your actions").locator("button[aria-disabled='false']").first
    page.keyboard.press(legal.inner_text().strip())
    expect(page).to_have_url(re.compile(r"actions=\d"))
    expect(turn).to_have_text(re.compile("Your turn|You won|You lost|Draw"))
    page.get_by_role("button", name="Change opponent").click()
    expect(page.get_by_role("button", name="Start game")).to_be_visible()


def test_illegal_actions_are_rejected(tab: Tab) -> None:
    page = tab.open(f"/leagues/{LEAGUE}/play#opponent=script:random&agent=player_1&seed=1&actions=4")
    expect(page.locator(".turn")).to_have_text(TURN)
    actions = page.get_by_role("group", name="Your actions")
    legal = actions.locator("button:not(.illegal)").first
    action = legal.inner_text().strip()
    actions.locator("button.illegal").first.click(force=True)
    legal.click()
    expect(page).to_have_url(re.compile(f"actions=4%2C{action}$"))  # after 4, without the illegal one
    page.goto(f"{tab.url}/leagues/{LEAGUE}/play#opponent=script:random&agent=player_1&seed=1&actions=99")
    page.reload()
    expect(page.locator("main").get_by_role("alert")).to_contain_text("99")
    tab.ignore(422)
    tab.ignore(400)


def test_named_actions_are_played_by_arrow_keys_and_wasd(tab: Tab) -> None:
    page = open_game(tab, NAMED, "player_1")
    turn, actions = page.locator(".turn"), page.get_by_role("group", name="Your actions")
    expect(turn).to_have_text(TURN)
    expect(actions.get_by_role("button", name="centre", exact=True)).to_be_visible()
    page.keyboard.press("ArrowDown")
    expect(page.locator(".move-log")).to_contain_text("player_1 plays down")
    expect(turn).to_have_text(TURN)
    page.keyboard.press("D")
    expect(page.locator(".move-log")).to_contain_text("player_1 plays right")
    expect(page.locator(".move-log")).to_contain_text("player_2 plays up-left")


def test_the_page_shows_colors_and_warns_of_pictures_that_show_everything(tab: Tab) -> None:
    page = open_game(tab, CONNECT_FOUR, "player_0")
    expect(page.locator(".turn")).to_have_text(TURN)
    expect(page.get_by_role("img", name="#d63c4c")).to_be_visible()
    expect(page.locator(".notice")).to_have_count(0)
    page = open_game(tab, HIDDEN, "player_1")
    expect(page.locator(".notice")).to_contain_text("what is hidden from player_1")


def test_the_page_says_how_versions_select_actions(tab: Tab) -> None:
    page = open_game(tab, HIDDEN, "player_1")
    page.get_by_role("button", name="Change opponent").click()
    expect(page.get_by_text("As in the matches of this league, versions sample their actions.")).to_be_visible()


@pytest.mark.parametrize("agent", VIEWS_OF_AGENTS)
def test_each_seat_sees_its_own_view(tab: Tab, agent: str) -> None:
    page = open_game(tab, VIEWS, agent)
    expect(page.locator(".turn")).to_have_text(TURN)
    expect(page.locator(".notice")).to_have_count(0)
    source = page.locator(".picture img").get_attribute("src")
    assert source is not None
    with Image.open(BytesIO(b64decode(source.partition("base64,")[2]))) as picture:
        assert set(picture.convert("L").getdata()) == {VIEWS_OF_AGENTS[agent]}


def test_teammates_are_no_opponents(tab: Tab) -> None:
    page = tab.open(f"/leagues/{TEAM}/play")
    expect(page.get_by_label("Teammates")).to_be_visible()
    page = open_game(tab, TEAM, "agent_1")
    expect(page.locator(".turn")).to_have_text(TURN)
    info = page.locator(".game-info")
    expect(info).to_contain_text(re.compile("You are agent_1 with script:first"))
    expect(info.get_by_role("list", name="Agents")).to_have_text(re.compile(r"agent_0 · teammate\s*agent_1 · you"))
    page.get_by_role("group", name="Your actions").get_by_role("button", name="1", exact=True).click()
    expect(page.locator(".move-log")).to_contain_text(re.compile(r"agent_0 plays \d; agent_1 plays 1 \(you\)"))
    expect(page.locator("main")).not_to_contain_text(re.compile("against|opponent", re.IGNORECASE))


def test_the_own_agent_is_marked_among_opponents(tab: Tab) -> None:
    page = open_game(tab, CONNECT_FOUR, "player_1")
    agents = page.get_by_role("list", name="Agents")
    expect(agents).to_have_text(re.compile(r"player_0 · opponent\s*player_1 · you"))
    expect(page.locator(".game-info")).to_contain_text("You are player_1 against script:first")


def test_matches_of_a_team_swap_no_sides(tab: Tab) -> None:
    pair = "first=script%3Arandom&second=script%3Afirst"
    page = tab.open(f"/leagues/{TEAM}/matches?{pair}")
    expect(page.get_by_role("heading", level=2)).to_have_text("script:random and script:first")
    expect(page.get_by_text("Each contestant plays one of them, as the whole team")).to_be_visible()
    expect_finished(page)
    expect(page.locator("main")).not_to_contain_text(re.compile("against|swap"))
    expect(page.get_by_role("columnheader", name="Games")).to_have_count(0)  # always two, as the text says
    page.get_by_role("link", name=re.compile("^Match ")).first.click()
    expect(page.get_by_role("table", name="Games").locator("tbody tr")).to_have_count(2)
    expect(page.locator("main")).not_to_contain_text("against")


def test_terms_are_explained(tab: Tab) -> None:
    page = tab.open(f"/leagues/{LEAGUE}")
    term = page.get_by_role("button", name="Rating")
    expect(page.get_by_role("note")).to_have_count(0)
    term.click()
    expect(page.get_by_role("note")).to_contain_text("Strength in Elo")
    page.keyboard.press("Escape")
    expect(page.get_by_role("note")).to_have_count(0)
