"""A league as one document: who stands where, who beats whom, what was decided and why, and what surprised.

Everything is read from the registry and the ledger, and nothing is changed. Games count that were played in the
league's present environment, by its present sides. How it looks is page.py's concern.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime

from evaluation.judgement import Judgement, judgement
from evaluation.pages.flipbook import Flipbook, flipbooks
from evaluation.pages.shares import Share, shares
from evaluation.played import MOST_CONTESTANTS, Played
from evaluation.report import Document, Payoff, RatedVersion, Standing, when
from evaluation.schedule import scoring
from evaluation.standings import rated
from league.refs import CHAMPION
from league.registry.registry import Registry
from league.registry.rows import AliasEvent
from league.results.records import Scoring

MOST_VERDICTS = 60
"""That are told with all their numbers, the newest ones."""
MOST_SURPRISES = 5


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
    played = Played(registry, row, MOST_SURPRISES)
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
        made_at=when(now or datetime.now(UTC)),
        champion=None if champion is None else f"{league}@{champion}",
        games=played.games,
        distinct_games=played.distinct_games,
        standings=standings,
        by_side=played.by_side(),
        payoff=table,
        shares=shares(table, played.matches) if table else (),
        versions=tuple(rated(version, standings, events) for version in versions),
        verdicts=tuple(judgement(registry, verdict, events) for verdict in reversed(verdicts) if verdict.id in shown),
        promotions=tuple(_promotion(event) for event in events),
        surprises=flipbooks(registry, league, played.greatest_surprises(), pictures),
        left_out=tuple(_left_out(len(standings), len(verdicts))),
    )


def _promotion(event: AliasEvent) -> Promotion:
    moved = "by hand" if event.verdict is None else "promotion"
    return Promotion(
        at=when(event.at),
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
