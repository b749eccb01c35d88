"""How fast are the web pages of a league with 200 versions and 100,000 matches?

On a real server over loopback: each call of the API behind them, one at a time on one connection, after an uncounted
first one, and pages from the end of lists; the first contentful paint of each page in headless Chromium, with an empty
cache; and the rate of the action route while a page of the league is open, divided by the rate without, in successive
pairs of runs, of which the median counts.
"""

import argparse
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from statistics import median

import httpx
import numpy as np
from playwright.sync_api import Browser, sync_playwright

from benchmarks.crowded_league import LEAGUE, crowd
from benchmarks.leagues.served_league import BODY
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


def main() -> int:
    """Print the measurements; 1 if a target was missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=50, help="repetitions of each call")
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--quick", action="store_true", help="smoke test: a small league, once")
    options = parser.parse_args()
    times, pairs, seconds = (5, 1, 2.0) if options.quick else (options.times, options.pairs, options.seconds)
    with tempfile.TemporaryDirectory() as scratch:
        home = Path(scratch) / "home"
        registry = crowd(home, versions=20, matches=5000) if options.quick else crowd(home)
        registry.close()
        with running(registry.storage, replicas=1) as url:
            slowest = _calls(url, times)
            with _browser() as browser:
                paint = max(
                    _paint(browser, url, path) for path in ("/", *(f"/leagues/{LEAGUE}{page}" for page in PAGES))
                )
                ratio = median(_pair(browser, url, seconds, bool(number % 2)) for number in range(pairs))
    print(f"\nslowest call, 95 %: {slowest:.0f} ms   (at most {CALL} ms)")
    print(f"slowest first contentful paint: {paint:.0f} ms   (at most {PAINT} ms)")
    print(f"actions with a page open over without: {ratio:.2f}×   (at least {RATE:g}×)")
    return int(slowest > CALL or paint > PAINT or ratio < RATE)


def _calls(url: str, times: int) -> float:
    """Time each call; returns the largest 95th percentile in milliseconds."""
    found = []
    with httpx.Client(base_url=url, timeout=30) as client:
        for path in _paths(client):
            _timed(client, path)
            took = [_timed(client, path) for _ in range(times)]
            p50, p95 = np.percentile(took, [50, 95])
            found.append(float(p95))
            print(f"{p50:6.1f} {p95:6.1f} ms   GET {path}", flush=True)
    return max(found)


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
    painted = float(entry.json_value())
    context.close()
    print(f"{painted:6.0f} ms   first contentful paint of {path}", flush=True)
    return painted


def _pair(browser: Browser, url: str, seconds: float, is_even: bool) -> float:
    """The rate of actions with an open page divided by that without, which is measured first in every other pair."""
    rates = {}
    for is_watched in (is_even, not is_even):
        with _watching(browser, url) if is_watched else nullcontext():
            load = measure(f"{url}/v1/policies/{LEAGUE}/action", BODY, connections=CONNECTIONS, seconds=seconds)
        assert not load.failed, "an action was not answered"
        rates[is_watched] = load.rate
    ratio = rates[True] / rates[False]
    print(f"{rates[False]:,.0f}/s, with a page open {rates[True]:,.0f}/s: {ratio:.2f}×", flush=True)
    return ratio


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


if __name__ == "__main__":
    sys.exit(main())
