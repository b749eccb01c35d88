"""A verdict, computed once more from the games that the ledger holds: whether its record is what they say.

Nothing of the record is taken for granted but the settings under which it was opened: the matches are held against
their schedule, scores against returns, and every number of the evidence against what follows from them. Games can be
played again from their seeds, too, so that not even returns need be believed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from evaluation.replay import replay
from evaluation.report import Document
from evaluation.verdicts import VOID, evidence_of, findings, report_of
from league.environments.lockstep import stepping
from league.errors import InvalidInput, LedgerRefusal, VerdictRefuted
from league.registry.registry import Registry
from league.registry.rows import VerdictRow
from league.results.admission import admit
from league.results.ledger import Ledger
from league.results.records import Match

ROUNDING = 1e-9
"""Numbers that differ by less, relative to their size, are the same on another machine."""


@dataclass(frozen=True, slots=True)
class Verification(Document):
    """A verdict that holds. matches: in the ledger. numbers: of its evidence that were computed again. replayed: games
    that were played again."""

    verdict: str
    outcome: str
    matches: int
    numbers: int
    replayed: int


def verify(verdict: str, *, registry: Registry, replays: int = 0) -> Verification:
    """Compute a closed verdict again, and play `replays` of the games that count once more, evenly spread over them.

    Raises VerdictRefuted, which names all that differs; NotFound; InvalidInput for a verdict that is open.
    """
    row = registry.verdict(verdict)
    if row.outcome is None or row.evidence is None:
        raise InvalidInput(f"verdict {verdict} is open: `league nightly` goes on with it")
    matches = _checked_matches(registry, row, row.schedule)
    for anchor in row.settings.get("anchors", ()):
        matches += _checked_matches(registry, row, anchor["schedule"])
    seen = findings(registry, row)
    # A void verdict ended for a reason beside its games, at any point of them.
    outcome = VOID if row.outcome == VOID else str(seen.outcome)
    note = seen.note if outcome not in (VOID, "promote") else row.evidence.get("note")
    computed = evidence_of(report_of(registry, row, outcome, seen, note))
    if row.outcome == VOID:
        # What a person voids keeps the evidence that it had: none while it was open, and its own outcome afterwards.
        computed = {name: value for name, value in computed.items() if name in row.evidence and name != "outcome"}
    wrong = [
        f"{name} is {row.evidence.get(name)!r}, and by the games {value!r}"
        for name, value in computed.items()
        if not _same(row.evidence.get(name), value)
    ]
    if wrong:
        raise VerdictRefuted(f"verdict {verdict} is not what its games say: {'; '.join(wrong)}")
    replayed = _replay(registry, row, matches, replays)
    return Verification(verdict, row.outcome, len(matches), len(computed), replayed)


def _checked_matches(registry: Registry, row: VerdictRow, name: str) -> list[Match]:
    """The matches of one of its schedules, each as that schedule asked for it, none missing."""
    ledger = Ledger(registry)
    schedule, matches = ledger.schedule(name), ledger.matches(league=row.league, schedule=name)
    try:
        for position, match in enumerate(matches):
            if match.position != position:
                raise VerdictRefuted(f"verdict {row.id} has no match {position} of {name}, but one behind it")
            admit(match, schedule)
    except LedgerRefusal as error:
        raise VerdictRefuted(f"verdict {row.id} counts a match that its schedule did not ask for: {error}") from error
    return matches


def _same(recorded: Any, computed: Any) -> bool:
    if isinstance(computed, dict):
        return isinstance(recorded, dict) and all(_same(recorded.get(key), value) for key, value in computed.items())
    if isinstance(computed, list):
        return isinstance(recorded, list) and len(recorded) == len(computed) and all(map(_same, recorded, computed))
    if isinstance(computed, float) and isinstance(recorded, int | float):
        return math.isclose(recorded, computed, rel_tol=ROUNDING, abs_tol=ROUNDING)
    return bool(recorded == computed)


def _replay(registry: Registry, row: VerdictRow, matches: Sequence[Match], replays: int) -> int:
    games = [(match, index) for match in matches for index in range(len(match.games))]
    wanted = min(replays, len(games))
    if not wanted:
        return 0
    league = registry.league(row.league)
    environment = stepping(league.config.environment, 1)
    try:
        for number in np.linspace(0, len(games) - 1, wanted).astype(int):
            match, index = games[number]
            for _ in replay(environment, league.config, league.interface, match, index):
                pass
    finally:
        environment.close()
    return wanted
