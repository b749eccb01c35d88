"""How fast are the web pages of a league with 200 versions and 100,000 matches?

On a real server over loopback: each call of the API behind them, one at a time on one connection, after an uncounted
first one, and pages from the end of lists; the first contentful paint of each page in headless Chromium, with an empty
cache; and the rate of the action route while a page of the league is open, divided by the rate without, in successive
pairs of runs, of which the median counts.
"""

import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from statistics import median
from typing import Annotated

import httpx
import numpy as np
import typer
from playwright.sync_api import Browser, sync_playwright

from benchmarks.harness import Quick, Target
from benchmarks.leagues.crowded_league import LEAGUE, crowd
from benchmarks.leagues.served_league import ACTION, BODY
from benchmarks.load.http import measure
from serve_app.runtime.launch import running

CALL = 100
"""Maximum 95th percentile of the requests of each call, in milliseconds."""
PAINT = 1000
"""Maximum time to the first contentful paint, in milliseconds."""
RATE = 0.95
"""Minimum ratio of the action route's rate with an open page to that without."""
CONNECTIONS = 32
CHROMIUM = ("--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update")
BELOW = f"/v1/leagues/{LEAGUE}"
LISTS = ("verdicts", "matches", "runs", "versions", "aliases/champion/history", "evaluations")
PAGES = ("", "/payoff", "/versions", "/verdicts", "/history", "/matches", "/evaluations", "/runs")
"""Paths relative to the page of the league."""


def main(
    quick: Quick = False,
    times: Annotated[int, typer.Option(help="repetitions of each call")] = 50,
    pairs: int = 5,
    seconds: float = 8.0,
) -> Iterator[Target]:
    """Measure calls, pages, and actions beside a page."""
    times, pairs, seconds = (5, 1, 2.0) if quick else (times, pairs, seconds)
    with tempfile.TemporaryDirectory() as scratch:
        home = Path(scratch) / "home"
        registry = crowd(home, versions=20, matches=5000) if quick else crowd(home)
        registry.close()
        with running(registry.storage, replicas=1) as url:
            yield _calls(url, times)
            with _browser() as browser:
                paints = [_paint(browser, url, path) for path in ("/", *(f"/leagues/{LEAGUE}{page}" for page in PAGES))]
                yield Target("first contentful paint of the pages", (min(paints), max(paints)), "ms", at_most=PAINT)
                ratios = [_pair(browser, url, seconds, bool(number % 2)) for number in range(pairs)]
                note = f"pairs {', '.join(f'{ratio:.2f}' for ratio in ratios)}"
                yield Target("actions beside an open page", median(ratios), "×", RATE, peer="without", note=note)


def _calls(url: str, times: int) -> Target:
    """Time each call."""
    slowest = []
    with httpx.Client(base_url=url, timeout=30) as client:
        for path in _paths(client):
            _timed(client, path)
            p50, p95 = np.percentile([_timed(client, path) for _ in range(times)], [50, 95])
            slowest.append(float(p95))
            print(f"{p50:6.1f} {p95:6.1f} ms   GET {path}", flush=True)
    return Target(f"slowest 95th percentile of {len(slowest)} calls", round(max(slowest)), "ms", at_most=CALL)


def _timed(client: httpx.Client, path: str) -> float:
    started = time.perf_counter()
    client.get(path).raise_for_status()
    return 1e3 * (time.perf_counter() - started)


def _paths(client: httpx.Client) -> Iterator[str]:
    """The calls of the web pages: for lists the default and the maximum page size, for matches also a page far down."""
    yield "/v1/leagues"
    yield BELOW
    for part in ("payoff", "ratings", "versions", "traffic"):
        yield f"{BELOW}/{part}"
    for query in ("", "?limit=200", "?offset=150"):
        yield f"{BELOW}/leaderboard{query}"
    for name in LISTS:
        yield f"{BELOW}/{name}?limit=50"
        yield f"{BELOW}/{name}?limit={100 if name == 'evaluations' else 200}"
    yield f"{BELOW}/matches?limit=50&before={_far(client)}"
    first, second = client.get(f"{BELOW}/leaderboard?limit=2").json()["leaderboard"]
    yield f"{BELOW}/matches?first={first['ref']}&second={second['ref']}"
    yield f"{BELOW}/aliases/champion/history?at=2026-03-03T14:00:00Z"
    for name, key in (("verdicts", "verdict"), ("matches", "match"), ("runs", "run")):
        (newest,) = client.get(f"{BELOW}/{name}?limit=1").json()[name]
        yield f"{BELOW}/{name}/{newest[key]}"


def _far(client: httpx.Client) -> str:
    """A match far down the list."""
    page = client.get(f"{BELOW}/matches?limit=200").json()
    for _ in range(100):
        if page["next"] is None:
            break
        last = page["next"]
        page = client.get(f"{BELOW}/matches?limit=200&before={last}").json()
    return str(page["matches"][0]["match"])


@contextmanager
def _browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=list(CHROMIUM))
        yield browser
        browser.close()


def _paint(browser: Browser, url: str, path: str) -> float:
    """Milliseconds from navigation to the first contentful paint, with an empty cache."""
    context = browser.new_context()
    page = context.new_page()
    page.goto(url + path)
    entry = page.wait_for_function("performance.getEntriesByName('first-contentful-paint')[0]?.startTime")
    painted = round(float(entry.json_value()))
    context.close()
    print(f"{painted:6.0f} ms   first contentful paint of {path}", flush=True)
    return painted


def _pair(browser: Browser, url: str, seconds: float, is_even: bool) -> float:
    """The rate of actions with an open page divided by that without, which is measured first in every other pair."""
    rates = {}
    for is_watched in (is_even, not is_even):
        with _watching(browser, url) if is_watched else nullcontext():
            load = measure(url + ACTION, BODY, connections=CONNECTIONS, seconds=seconds)
        assert not load.failed, "an action was not answered"
        rates[is_watched] = load.rate
    return rates[True] / rates[False]


@contextmanager
def _watching(browser: Browser, url: str) -> Iterator[None]:
    """Keep the page of the league open."""
    context = browser.new_context()
    page = context.new_page()
    with page.expect_response("**/events"):
        page.goto(f"{url}/leagues/{LEAGUE}")
    page.get_by_role("table").first.wait_for()
    yield
    context.close()
