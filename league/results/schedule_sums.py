"""The sums of one schedule, as rows of the tables in which the ledger keeps them."""

import struct
from collections.abc import Iterable, Sequence
from operator import itemgetter
from typing import Any

from league.registry.storage.tables import DIGEST_BYTES, STRIPE
from league.results.records import Match, Schedule
from league.results.sums import (
    Examples,
    Pair,
    PairSums,
    dump_examples,
    examples,
    game_digest,
    load_examples,
    merged,
    tally,
)

Row = dict[str, Any]


class ScheduleSums:
    """Sums over matches of a schedule, with the digests of their games."""

    def __init__(self, schedule: Schedule) -> None:
        self._key: Row = {"schedule": schedule.id, "league": schedule.league}
        self._schedule = schedule.id
        self._pairs: dict[Pair, PairSums] = {}
        self._examples: dict[Pair, Examples] = {}
        self._digests: dict[int, bytearray] = {}
        self.matches = 0
        self.size = 0
        """Characters of the recorded games."""

    def load(self, pairs: Iterable[Any], digests: Iterable[Any]) -> None:
        """Take over rows of the tables, before matches are added to them."""
        for row in pairs:
            self._pairs[row.first, row.second] = PairSums.load(row.sums)
            self._examples[row.first, row.second] = load_examples(row.examples, self._schedule)
        for row in digests:
            self._digests[row.stripe] = bytearray(row.digests)

    def add(self, matches: Sequence[Match]) -> None:
        """Add matches of the schedule, each once."""
        self.matches += len(matches)
        for pair, of_pair in tally(matches).items():
            self._pairs.setdefault(pair, PairSums()).add(of_pair)
        digests = [[game_digest(match, game) for game in match.games] for match in matches]
        for pair, of_games in examples(matches, digests).items():
            self._examples[pair] = merged([self._examples.get(pair, {}), of_games])
        for match, of_match in zip(matches, digests, strict=True):
            stripe = self._digests.setdefault(match.position // STRIPE, bytearray())
            start = match.position % STRIPE * DIGEST_BYTES
            stripe.extend(bytes(max(0, start + DIGEST_BYTES - len(stripe))))
            stripe[start : start + DIGEST_BYTES] = struct.pack("<2Q", *of_match)

    def total(self) -> Row:
        """Return the row of the totals."""
        return self._key | {"matches": self.matches, "size": self.size}

    def pair_rows(self) -> list[Row]:
        """Return the rows of the pairs."""
        return [
            self._key
            | {
                "first": pair[0],
                "second": pair[1],
                "sums": of_pair.dump(),
                "examples": dump_examples(self._examples.get(pair, {})),
            }
            for pair, of_pair in sorted(self._pairs.items(), key=itemgetter(0))
        ]

    def digest_rows(self) -> list[Row]:
        """Return the rows of the digests."""
        return [
            self._key | {"stripe": stripe, "digests": bytes(digests)}
            for stripe, digests in sorted(self._digests.items())
        ]
