"""How many requests each league answers, and how many a second: of a replica between two reports, of all together."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from time import monotonic

from serve_app.metrics import Report, Samples

SECONDS = "league_request_seconds"
RATE = "league_requests_per_second"


@dataclass(frozen=True, slots=True)
class Requests:
    """Of one league, at all replicas that report."""

    count: int = 0
    """Since they started."""
    rate: float = 0.0
    """A second, between their last two reports."""


class RequestRates:
    """What a replica adds to its reports."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._at = monotonic()

    def since_last(self, report: Report) -> Samples:
        """league → requests a second since the last call, of this report's leagues."""
        counts, now = _counts(report), monotonic()
        seconds = max(now - self._at, 1e-3)
        # Of policies that were not asked for long, counts are forgotten.
        rates: Samples = [
            [[league], max(count - self._counts[league], 0) / seconds] for league, count in counts.items()
        ]
        self._counts, self._at = counts, now
        return rates


def requests(reports: Iterable[Report]) -> dict[str, Requests]:
    """league → its requests, of those that were asked for anything."""
    counts: Counter[str] = Counter()
    rates: Counter[str] = Counter()
    for report in reports:
        counts += _counts(report)
        for (league,), rate in report.get(RATE, ()):
            rates[league] += rate
    return {league: Requests(count, float(rates[league])) for league, count in counts.items()}


def _counts(report: Report) -> Counter[str]:
    counts: Counter[str] = Counter()
    for (league, *_), value in report.get(SECONDS, ()):
        counts[league] += sum(value["counts"])
    return counts
