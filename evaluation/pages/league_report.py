"""A league as one document: who stands where, who beats whom, what was decided and why, and what surprised.

Everything is read from the registry and the ledger, and nothing is changed. Games count that were played in the
league's present environment, by its present sides. How it looks is page.py's concern.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime

from evaluation.gate import Decision, identity
from evaluation.pages.flipbook import Flipbook, flipbooks
from evaluation.pages.shares import Share, shares
from evaluation.pages.surprises import Surprises
from evaluation.paired import paired_difference
from evaluation.payoff import tabulate
from evaluation.report import AnchorReport, Confirmation, Difference, Document, Payoff, Standing
from evaluation.schedule import scoring
from evaluation.standings import by_side, ranked
from evaluation.verdicts import anchor_report, confirmation, findings, gate_of
from league.refs import CHAMPION
from league.registry.registry import Registry
from league.registry.rows import AliasEvent, LeagueRow, VerdictRow, VersionRow
from league.results.ledger import Ledger
from league.results.records import Match, Scoring

MOST_CONTESTANTS = 40
"""In the payoff table, the best ones: a table of more is read by nobody."""
MOST_VERDICTS = 60
"""That are told with all their numbers, the newest ones."""
MOST_SURPRISES = 5
OPEN = "open"


@dataclass(frozen=True, slots=True)
class RatedVersion(Document):
    """A version on its way. rating, interval: as in a Standing. champion_at: each time that it became champion."""

    ref: str
    number: int
    made_at: str
    steps: int
    parent: int | None
    rating: float | None
    interval: tuple[float, float] | None
    games: int
    champion_at: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Judgement(Document):
    """A verdict with its evidence, computed from the ledger.

    outcome: a verdict's, or `open`. reason: why it came out so, in a sentence.
    hypotheses: elo0 and elo1 in `model`, or two mean differences of returns.
    curve: the LLR after each block; it decides at `bounds`.
    counts: blocks in each cell, worst for the candidate first.
    elo, interval, difference: as in a VerdictReport.
    alpha: the error that the verdict may spend. anchors: its tests of non-inferiority. confirmation: the fresh match
    after its promotion.
    """

    verdict: str
    candidate: str
    opponent: str
    outcome: str
    promoted: bool
    reason: str
    opened_at: str
    closed_at: str | None
    model: str
    hypotheses: tuple[float, float]
    llr: float
    bounds: tuple[float, float]
    curve: tuple[float, ...]
    blocks: int
    games: int
    distinct_games: int
    counts: tuple[int, ...]
    score: float | None
    elo: float | None
    interval: tuple[float | None, float | None] | None
    difference: Difference | None
    alpha: float
    anchors: tuple[AnchorReport, ...]
    confirmation: Confirmation | None


@dataclass(frozen=True, slots=True)
class Promotion(Document):
    """One movement of `champion`. kind: `promotion`, `rollback`, or `by hand`."""

    at: str
    kind: str
    champion: str
    before: str | None
    actor: str
    reason: str
    verdict: str | None


@dataclass(frozen=True, slots=True)
class LeagueReport(Document):
    """What there is to say of a league.

    standings: best first. by_side: the same on each side, empty where sides are alike, or there is one.
    payoff: between the best contestants, None before anybody met. shares: of those who have all met, else empty.
    versions: oldest first. verdicts, promotions: newest first. left_out: what is not told, in sentences.
    """

    league: str
    environment: str
    environment_digest: str
    sides: tuple[str, ...]
    scoring: Scoring
    made_at: str
    champion: str | None
    games: int
    distinct_games: int
    standings: tuple[Standing, ...]
    by_side: dict[str, tuple[Standing, ...]]
    payoff: Payoff | None
    shares: tuple[Share, ...]
    versions: tuple[RatedVersion, ...]
    verdicts: tuple[Judgement, ...]
    promotions: tuple[Promotion, ...]
    surprises: tuple[Flipbook, ...]
    left_out: tuple[str, ...]


def league_report(
    registry: Registry, league: str, *, pictures: bool = True, now: datetime | None = None
) -> LeagueReport:
    """Read everything of a league. Raises UnknownLeague.

    pictures: whether surprising games get them, where the environment draws any.
    """
    row = registry.league(league)
    versions, verdicts, events = registry.versions(league), registry.verdicts(league), registry.history(league)
    played = _Played(registry, row)
    table = played.payoff()
    shown = {verdict.id for verdict in verdicts[-MOST_VERDICTS:]}
    champion = registry.aliases(league).get(CHAMPION)
    standings = played.standings
    return LeagueReport(
        league=league,
        environment=row.config.environment.entry_point,
        environment_digest=row.environment_digest,
        sides=tuple(row.interface.sides),
        scoring=scoring(row.config, row.interface),
        made_at=_when(now or datetime.now(UTC)),
        champion=None if champion is None else f"{league}@{champion}",
        games=played.games,
        distinct_games=played.distinct_games,
        standings=standings,
        by_side=played.by_side(),
        payoff=table,
        shares=shares(table, played.matches) if table else (),
        versions=tuple(_rated(version, standings, events) for version in versions),
        verdicts=tuple(_judgement(registry, verdict, events) for verdict in reversed(verdicts) if verdict.id in shown),
        promotions=tuple(_promotion(event) for event in events),
        surprises=flipbooks(registry, league, played.surprises.greatest(), pictures),
        left_out=tuple(_left_out(len(standings), len(verdicts))),
    )


class _Played:
    """The games that count, read schedule by schedule, so that the moves of few of them are in memory at a time."""

    def __init__(self, registry: Registry, league: LeagueRow) -> None:
        self._sides = tuple(league.interface.sides)
        self._is_rated_by_side = scoring(league.config, league.interface) == "side" and len(self._sides) > 1
        ledger = Ledger(registry)
        purged = ledger.purged(league.slug)
        schedules = {
            schedule.id: schedule
            for schedule in ledger.schedules(league.slug)
            if schedule.id not in purged
            and (schedule.environment_digest, schedule.sides) == (league.environment_digest, self._sides)
        }
        results = [result for result in ledger.results(league.slug) if result.schedule in schedules]
        self.games = 0
        self.standings: tuple[Standing, ...] = ranked(results)
        self._best = [standing.ref for standing in self.standings[:MOST_CONTESTANTS]]
        self.matches: list[Match] = []
        """Without moves: of the contestants in the payoff table, or all where sides are rated."""
        ratings = {standing.ref: standing.rating for standing in self.standings if standing.rating is not None}
        self.surprises = Surprises(ratings, MOST_SURPRISES)
        self._seen: set[bytes] = set()
        self._distinct: Counter[str] = Counter()
        for schedule in schedules.values():
            for match in ledger.matches(league=league.slug, schedule=schedule.id):
                self._take(match)
        self.distinct_games = len(self._seen)
        self.standings = tuple(replace(each, distinct_games=self._distinct[each.ref]) for each in self.standings)

    def _take(self, match: Match) -> None:
        self.surprises.see(match)
        self.games += len(match.games)
        for game in match.games:
            if (key := identity(match, game)) not in self._seen:
                self._seen.add(key)
                self._distinct.update({match.contestants[number] for number in game.sides})
        if self._is_rated_by_side or all(ref in self._best for ref in match.contestants):
            games = tuple(replace(game, opening=(), actions=()) for game in match.games)
            self.matches.append(replace(match, games=games))

    def payoff(self) -> Payoff | None:
        best = set(self._best)
        between = [match for match in self.matches if set(match.contestants) <= best]
        return tabulate(self._best, self._sides, between) if between else None

    def by_side(self) -> dict[str, tuple[Standing, ...]]:
        return by_side(self._sides, self.matches) if self._is_rated_by_side and self.matches else {}


def _rated(version: VersionRow, standings: Sequence[Standing], events: Sequence[AliasEvent]) -> RatedVersion:
    standing = next((each for each in standings if each.ref == version.ref), None)
    return RatedVersion(
        ref=version.ref,
        number=version.number,
        made_at=_when(version.created_at),
        steps=version.steps,
        parent=version.parent,
        rating=standing.rating if standing else None,
        interval=standing.interval if standing else None,
        games=standing.games if standing else 0,
        champion_at=tuple(_when(event.at) for event in reversed(events) if event.version == version.number),
    )


def _judgement(registry: Registry, verdict: VerdictRow, events: Sequence[AliasEvent]) -> Judgement:
    candidate = f"{verdict.league}@{verdict.candidate}"
    gate = gate_of(verdict)
    matches = Ledger(registry).matches(league=verdict.league, schedule=verdict.schedule)
    seen = findings(registry, verdict)
    decision = seen.champion
    promoted = any(event.verdict == verdict.id for event in events)
    estimate = decision.estimate
    sided = Ledger(registry).schedule(verdict.schedule).scoring == "side"
    return Judgement(
        verdict=verdict.id,
        candidate=candidate,
        opponent=verdict.champion,
        outcome=verdict.outcome or OPEN,
        promoted=promoted,
        reason=_reason(verdict, decision, promoted),
        opened_at=_when(verdict.opened_at),
        closed_at=_when(verdict.closed_at) if verdict.closed_at else None,
        model=gate.model,
        hypotheses=(gate.return0, gate.return1) if gate.model == "returns" else (gate.elo0, gate.elo1),
        llr=decision.llr,
        bounds=decision.bounds,
        curve=decision.curve,
        blocks=decision.blocks,
        games=decision.games,
        distinct_games=decision.distinct_games or 0,
        counts=decision.counts,
        score=decision.score,
        elo=_finite(estimate.elo) if estimate else None,
        interval=(_finite(estimate.low), _finite(estimate.high)) if estimate else None,
        difference=paired_difference(matches[: decision.blocks], candidate) if sided else None,
        alpha=verdict.alpha,
        anchors=tuple(map(anchor_report, seen.anchors)),
        confirmation=confirmation(registry, verdict),
    )


def _reason(verdict: VerdictRow, decision: Decision, promoted: bool) -> str:
    """Why a verdict came out as it did, in a sentence."""
    note = (verdict.evidence or {}).get("note")
    llr, lower, upper = (f"{value:.2f}".replace("-", "−") for value in (decision.llr, *decision.bounds))
    after = f"after {decision.games} games the LLR was {llr}"
    match verdict.outcome:
        case None:
            return f"It is not decided yet: {after}, between {lower} and {upper}."
        case "promote" if promoted:
            return f"It is the stronger one: {after}, and {upper} is enough."
        case "promote":
            return f"It is the stronger one ({after}), but was not promoted: {note or 'no reason was recorded'}."
        case "inconclusive":
            return note or f"Nothing was decided: {after}, between {lower} and {upper}, and no more are played."
        case "reject" if note is None and decision.llr <= decision.bounds[0]:
            return f"It is not the stronger one: {after}, and below {lower} it is given up."
    return note or f"{str(verdict.outcome).capitalize()}: {after}."


def _promotion(event: AliasEvent) -> Promotion:
    moved = "by hand" if event.verdict is None else "promotion"
    return Promotion(
        at=_when(event.at),
        kind="rollback" if event.kind == "rollback" else moved,
        champion=f"{event.league}@{event.version}",
        before=None if event.previous is None else f"{event.league}@{event.previous}",
        actor=event.actor,
        reason=event.reason,
        verdict=event.verdict,
    )


def _left_out(contestants: int, verdicts: int) -> Iterator[str]:
    if contestants > MOST_CONTESTANTS:
        yield f"The payoff table has the best {MOST_CONTESTANTS} of {contestants} contestants."
    if verdicts > MOST_VERDICTS:
        yield f"Of {verdicts} verdicts the newest {MOST_VERDICTS} are told."


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _when(moment: datetime) -> str:
    return moment.astimezone(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
