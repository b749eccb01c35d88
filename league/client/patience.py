"""Whether a call that brought no answer is made again, and when.

Every call of the client may be repeated: to act changes nothing, what is drawn follows from a seed that the call holds,
and a call that changes what is served carries an Idempotency-Key.
"""

import random
from time import monotonic
from typing import Any

import httpx
import orjson

FIRST = 0.01
"""Seconds before the second attempt; twice as long before each further one, and varied so that clients spread."""
LONGEST = 1.0
"""Seconds between two attempts, at most, unless the server asks for more."""
SPREAD = 0.5
"""Share of a pause that varies."""
SECOND_THOUGHTS = 1.0
"""Seconds for which a server that says that it cannot answer is asked again: what it says may be over by then."""
BUSY = (429, 502, 504)
"""Statuses of a server that has too much to do, or whose replica was lost."""

LOOK = 0.05
"""Seconds between two looks at what is waited for."""

Outcome = httpx.Response | httpx.TransportError


class Attempts:
    """The attempts of one call. seconds: after which no other one begins."""

    __slots__ = ("_begun", "_pause", "_seconds")

    def __init__(self, seconds: float) -> None:
        self._begun = monotonic()
        self._seconds = seconds
        self._pause = FIRST

    def pause(self, outcome: Outcome) -> float | None:
        """Seconds until the next attempt; None if the outcome counts."""
        if isinstance(outcome, httpx.Response) and outcome.status_code < 400:
            return None
        seconds = min(self._seconds, hope(outcome))
        return self.pause_within(seconds, asked_for(outcome)) if seconds > 0 else None

    def pause_within(self, seconds: float, least: float = 0.0) -> float | None:
        """The next pause, of `least` seconds or more; None if more than `seconds` would have passed by its end."""
        pause = max(least, self._pause * random.uniform(1 - SPREAD, 1 + SPREAD))
        self._pause = min(2 * self._pause, LONGEST)
        return pause if monotonic() - self._begun + pause <= seconds else None


def hope(outcome: Outcome) -> float:
    """For how many seconds the same call may yet bring something else: none, a few, or as long as one waits."""
    if not isinstance(outcome, httpx.Response) or outcome.status_code in BUSY:
        return float("inf")
    if told(outcome) is None:
        # HAProxy's own words: no replica took the request (500, 503), or it does not know of any yet (404).
        return float("inf") if outcome.status_code >= 500 else SECOND_THOUGHTS * (outcome.status_code == 404)
    return SECOND_THOUGHTS * (outcome.status_code == 503)


def told(reply: httpx.Response) -> dict[str, Any] | None:
    """The JSON object that a server of ours answers; None if that is none, and so somebody else's answer."""
    try:
        document = orjson.loads(reply.content)
    except orjson.JSONDecodeError:
        return None
    return document if isinstance(document, dict) else None


def asked_for(outcome: Outcome) -> float:
    """Seconds that a busy server asks for."""
    if not isinstance(outcome, httpx.Response) or outcome.status_code != 429:
        return 0.0
    seconds = outcome.headers.get("retry-after", "")
    return float(seconds) if seconds.isascii() and seconds.isdigit() else 0.0
