"""Verifies a verdict: recomputes its evidence from the games in the ledger and compares it with the record.

Only the settings under which the verdict was opened are trusted. Matches are checked against their schedule, scores
against returns, and every number of the evidence against the recomputed one. Games can also be replayed from their
seeds, which verifies the returns themselves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np

from evaluation.documents import Document
from evaluation.gating.criteria.criterion import Contest
from evaluation.gating.evidence import evidence, gate_result
from evaluation.playback.replay import replay
from league.environments.implementation import stock_stepping
from league.errors import EnvironmentMismatch, InvalidInput, LedgerConflict, VerdictRefuted
from league.registry.gateways import ForSimulators
from league.registry.registry import Registry
from league.registry.storage.rows import LeagueRow, VerdictRow
from league.registry.verdicts import VOID
from league.results.ledger import Ledger
from league.results.records import Match
from league.results.scoring import admit

ROUNDING = 1e-6
"""Tolerance for derived floats (LLR, Elo, scores, intervals), relative and absolute: rounding differs between
processors and BLAS kernels, and iterative estimates converge to 1e-8. Outcomes, counts and games must be equal."""

SENTENCES = ("reason", "remedy", "finding")
"""Fields of the evidence that are in the words of the release that wrote them."""


@dataclass(frozen=True, slots=True)
class Verification(Document):
    """A verdict that was verified.

    matches: matches in the ledger. numbers: recomputed fields of the evidence. replayed: replayed games.
    is_current: whether its games count today: neither the league's game nor the selection of actions has changed since.
    reason, remedy: as in a VerdictReport.
    """

    verdict: str
    outcome: str
    matches: int
    numbers: int
    replayed: int
    is_current: bool
    reason: str
    remedy: str | None


def verify(verdict: str, *, registry: Registry, replays: int = 0) -> Verification:
    """Recompute a closed verdict, and replay `replays` of its games, evenly spaced.

    Args:
        verdict: Its id, or a unique beginning of it or of its digest.
        registry: The registry.
        replays: Number of games to replay.

    Raises:
        VerdictRefuted: The record differs, with every difference in the message, or a game cannot be replayed.
        NotFound: There is no such verdict.
        InvalidInput: The verdict is open.
    """
    row = registry.verdicts.find(verdict)
    if row.outcome is None or row.evidence is None:
        raise InvalidInput(f"verdict {row.short_id} is still open: `league nightly` resumes it")
    matches = [match for name in row.tested_schedules for match in _checked_matches(registry, row, name)]
    contest = Contest.of(registry, row)
    result = gate_result(contest)
    # A verdict can be voided for reasons outside its games, at any point.
    outcome = VOID if row.outcome == VOID else str(result.outcome)
    note = result.note if outcome not in (VOID, "promote") else row.evidence.get("note")
    recomputed = evidence(contest, result, outcome, note)
    computed = {name: value for name, value in recomputed.to_record().items() if name not in SENTENCES}
    if row.outcome == VOID:
        # A voided verdict keeps its evidence, which is empty if it was open.
        computed = {name: value for name, value in computed.items() if name in row.evidence and name != "outcome"}
    wrong = [
        f"{name} is {row.evidence.get(name)!r}, but the games give {value!r}"
        for name, value in computed.items()
        if not _same(row.evidence.get(name), value)
    ]
    if wrong:
        raise VerdictRefuted(f"the record of verdict {row.short_id} contradicts its games: {'; '.join(wrong)}")
    replayed = _replay(registry, row, matches, replays)
    ledger = Ledger(registry)
    for schedule in map(ledger.schedule, row.tested_schedules):
        if differences := ledger.recount(schedule, mend=False):
            raise VerdictRefuted(
                f"the sums of schedule {schedule.id} contradict its games: {', '.join(differences)}; "
                f"`league recount {row.league}` replaces them"
            )
    conditions = ledger.schedule(row.schedule).conditions
    is_current = conditions == registry.leagues.get(row.league).conditions
    return Verification(
        row.id, row.outcome, len(matches), len(computed), replayed, is_current, recomputed.reason, recomputed.remedy
    )


def _checked_matches(registry: Registry, row: VerdictRow, name: str) -> list[Match]:
    """All matches of one of its schedules, each checked against the schedule."""
    ledger = Ledger(registry)
    schedule, matches = ledger.schedule(name), ledger.matches(league=row.league, schedule=name)
    try:
        for position, match in enumerate(matches):
            if match.position != position:
                raise VerdictRefuted(f"verdict {row.short_id} lacks match {position} of {name} but has a later one")
            admit(match, schedule)
    except LedgerConflict as error:
        raise VerdictRefuted(f"verdict {row.short_id} counts a match that contradicts its schedule: {error}") from error
    return matches


def _same(recorded: Any, computed: Any) -> bool:
    if isinstance(computed, dict):
        return isinstance(recorded, dict) and all(
            key in SENTENCES or _same(recorded.get(key), value) for key, value in computed.items()
        )
    if isinstance(computed, list):
        return isinstance(recorded, list) and len(recorded) == len(computed) and all(map(_same, recorded, computed))
    if isinstance(computed, float) and isinstance(recorded, int | float):
        return math.isclose(recorded, computed, rel_tol=ROUNDING, abs_tol=ROUNDING)
    return bool(recorded == computed)


def _replay(registry: Registry, row: VerdictRow, matches: Sequence[Match], replays: int) -> int:
    games = [(match, index) for match in matches for index in range(len(match.games))]
    count = min(replays, len(games))
    if not count:
        return 0
    league = registry.leagues.get(row.league)
    external = league.config.environment.external
    if external is not None and not external.deterministic:
        return 0  # the simulator's word is all there is
    simulators = ForSimulators(registry.storage, row.league)
    with closing(stock_stepping(league.config.environment, 1, simulators=simulators)) as environment:
        for number in np.linspace(0, len(games) - 1, count).astype(int):
            match, index = games[number]
            try:
                for _ in replay(environment, league.config, league.interface, match, index):
                    pass
            except EnvironmentMismatch as error:
                raise VerdictRefuted(f"verdict {row.short_id}: {error}{_cause(registry, league, match)}") from error
    return count


def _cause(registry: Registry, league: LeagueRow, match: Match) -> str:
    """Name a changed environment as the cause of a game that cannot be replayed."""
    if Ledger(registry).schedule(match.schedule).game_digest == league.config.game_digest():
        return ""
    return "; the environment has changed since then: its settings or code, a library, or the rules of play"
