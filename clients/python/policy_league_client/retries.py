"""Retries of the client: which failures are temporary, the backoff between attempts, and the retry deadline.

Every request is safe to repeat: inference changes nothing, its random choices depend on the seed in the request, and
requests that change something carry an Idempotency-Key.
"""

import random
from time import monotonic
from typing import Any

import httpx
import orjson

from policy_league_client.errors import BY_CODE, InvalidInput, LeagueError, NoReplica, RateLimited, RemoteError

INITIAL_DELAY = 0.01
"""Seconds before the second attempt; doubled before each further attempt."""
MAX_DELAY = 1.0
"""Maximum of seconds between attempts, unless the server specifies more."""
JITTER = 0.5
"""Relative range of the random variation of delays, which spreads the load of many clients."""
NOT_READY_DEADLINE = 1.0
"""Seconds for which a request is retried after a server reported that it is not ready."""
BUSY_STATUSES = (429, 502, 504)
"""HTTP statuses of an overloaded server or a lost replica."""

POLL_INTERVAL = 0.05
"""Seconds between two requests that poll a state."""

Outcome = httpx.Response | httpx.TransportError


class Retries:
    """The attempts of one request. deadline: seconds after the first attempt until which the request is retried."""

    __slots__ = ("_deadline", "_delay", "_start")

    def __init__(self, deadline: float) -> None:
        self._start = monotonic()
        self._deadline = deadline
        self._delay = INITIAL_DELAY

    def next_delay(self, outcome: Outcome) -> float | None:
        """Return the seconds until the next attempt; None if the outcome is final."""
        if isinstance(outcome, httpx.Response) and outcome.status_code < 400:
            return None
        deadline = min(self._deadline, retry_deadline(outcome))
        return self.delay_within(deadline, retry_after(outcome)) if deadline > 0 else None

    def delay_within(self, deadline: float, minimum: float = 0.0) -> float | None:
        """Return the next delay, at least `minimum` seconds; None if it would end after the deadline."""
        delay = max(minimum, self._delay * random.uniform(1 - JITTER, 1 + JITTER))
        self._delay = min(2 * self._delay, MAX_DELAY)
        return delay if monotonic() - self._start + delay <= deadline else None


def retry_deadline(outcome: Outcome) -> float:
    """Return the seconds for which a failure is worth retrying: 0, a few, or infinity."""
    if not isinstance(outcome, httpx.Response) or outcome.status_code in BUSY_STATUSES:
        return float("inf")
    body = parse_object(outcome.content)
    if body is None:
        # Responses of a proxy that is not configured by this project, or knows no replica yet (404).
        return float("inf") if outcome.status_code >= 500 else NOT_READY_DEADLINE * (outcome.status_code == 404)
    if body.get("code") == NoReplica.code:
        return float("inf")
    return NOT_READY_DEADLINE * (outcome.status_code == 503)


def parse_object(content: str | bytes) -> dict[str, Any] | None:
    """Return the JSON object in a response or message; None if it is something else, and not from a policy server."""
    try:
        body = orjson.loads(content)
    except orjson.JSONDecodeError:
        return None
    return body if isinstance(body, dict) else None


def retry_after(outcome: Outcome) -> float:
    """Return the minimal delay in seconds that a busy server specifies."""
    if not isinstance(outcome, httpx.Response) or outcome.status_code != 429:
        return 0.0
    seconds = outcome.headers.get("retry-after", "")
    return float(seconds) if seconds.isascii() and seconds.isdigit() else 0.0


def parse_error(response: httpx.Response, url: str) -> LeagueError:
    """Return the error in a response: RemoteError if it has no `code` and `message`."""
    body = parse_object(response.content)
    if body is None or "code" not in body or "message" not in body:
        return RemoteError(f"{url} returned status {response.status_code}: {response.text[:200]}")
    kind = BY_CODE.get(body["code"])
    if kind is RateLimited:
        return RateLimited(body["message"], retry_after(response))
    return (kind or (InvalidInput if response.status_code < 500 else RemoteError))(body["message"])
