"""League report: leaderboard, payoff matrix, verdicts with reasons, promotions and upsets as one document.

Everything is read from the registry and the ledger; nothing is changed. Games count if they were played in the league's
current environment with its current sides and action selection. html_page.py renders the report.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime

from evaluation.gating.verdict_evidence import VerdictEvidence, verdict_evidence
from evaluation.matches.leaderboard import MOST_CONTESTANTS, CountedGames, rated_version
from evaluation.reporting.flipbook import Flipbook, flipbooks
from evaluation.reporting.gate_record import why_not_champion
from evaluation.results import Document, Payoff, RatedVersion, Standing, iso_timestamp
from evaluation.statistics.population import PopulationShare, shares
from league.conditions import ActionSelection
from league.refs import CHAMPION
from league.registry.registry import Registry
from league.registry.storage.rows import AliasEvent, VersionRow
from league.results.records import Scoring
from league.results.scoring import scoring

MOST_VERDICTS = 60
"""Verdicts with all details, the newest ones."""


@dataclass(frozen=True, slots=True)
class ChampionChange(Document):
    """One change of `champion`. kind: `promotion`, `rollback`, or `by hand`."""

    at: str
    kind: str
    champion: str
    before: str | None
    actor: str
    reason: str
    verdict: str | None


@dataclass(frozen=True, slots=True)
class LeagueReport(Document):
    """The state of a league.

    leaderboard: best first. not_champion: why its best version is not the champion, if so.
    by_side: leaderboard of each side, empty if sides are alike or there is only one.
    payoff: of the best contestants, None before the first game. shares: of contestants that have all met, else empty.
    versions: oldest first. roles: of exploiters and mixtures, by reference. verdicts, promotions: newest first.
    left_out: what is omitted, in sentences.
    """

    league: str
    environment: str
    environment_digest: str
    sides: tuple[str, ...]
    scoring: Scoring
    actions: ActionSelection
    made_at: str
    champion: str | None
    games: int
    unique_games: int
    leaderboard: tuple[Standing, ...]
    not_champion: str | None
    by_side: dict[str, tuple[Standing, ...]]
    payoff: Payoff | None
    shares: tuple[PopulationShare, ...]
    versions: tuple[RatedVersion, ...]
    roles: dict[str, str]
    verdicts: tuple[VerdictEvidence, ...]
    promotions: tuple[ChampionChange, ...]
    upsets: tuple[Flipbook, ...]
    left_out: tuple[str, ...]


def league_report(
    registry: Registry, league: str, *, pictures: bool = True, now: datetime | None = None
) -> LeagueReport:
    """Create the report. pictures: whether upsets include images. Raises UnknownLeague."""
    row, versions = registry.leagues.get(league), registry.versions.all(league)
    verdicts, events = registry.verdicts.all(league), registry.aliases.history(league)
    played = CountedGames(registry, row)
    table = played.payoff()
    reported_ids = {verdict.id for verdict in verdicts[-MOST_VERDICTS:]}
    champion = registry.aliases.current(league).get(CHAMPION)
    leaderboard = played.leaderboard
    return LeagueReport(
        league=league,
        environment=row.config.environment.entry_point,
        environment_digest=row.environment_digest,
        sides=tuple(row.interface.sides),
        scoring=scoring(row.config, row.interface),
        actions=row.conditions.actions,
        made_at=iso_timestamp(now or datetime.now(UTC)),
        champion=None if champion is None else f"{league}@{champion}",
        games=played.games,
        unique_games=played.unique_games,
        leaderboard=leaderboard,
        not_champion=why_not_champion(registry, league, leaderboard),
        by_side=played.by_side(),
        payoff=table,
        shares=shares(table, played.matches) if table else (),
        versions=tuple(rated_version(version, leaderboard, events) for version in versions),
        roles={version.ref: role for version in versions if (role := _role(version))},
        verdicts=tuple(
            verdict_evidence(registry, verdict, events) for verdict in reversed(verdicts) if verdict.id in reported_ids
        ),
        promotions=tuple(_promotion(event) for event in events),
        upsets=flipbooks(registry, league, played.greatest_upsets(), pictures),
        left_out=tuple(_left_out(len(leaderboard), len(verdicts))),
    )


def _role(version: VersionRow) -> str | None:
    if version.mixture is not None:
        return f"mixture of {version.mixture}"
    return None if version.exploits is None else f"exploiter of {version.exploits}"


def _promotion(event: AliasEvent) -> ChampionChange:
    moved = "by hand" if event.verdict is None else "promotion"
    return ChampionChange(
        at=iso_timestamp(event.at),
        kind="rollback" if event.kind == "rollback" else moved,
        champion=f"{event.league}@{event.version}",
        before=None if event.previous is None else f"{event.league}@{event.previous}",
        actor=event.actor,
        reason=event.reason,
        verdict=event.verdict,
    )


def _left_out(contestants: int, verdicts: int) -> Iterator[str]:
    if contestants > MOST_CONTESTANTS:
        yield f"The payoff matrix contains the best {MOST_CONTESTANTS} of {contestants} contestants."
    if verdicts > MOST_VERDICTS:
        yield f"Only the newest {MOST_VERDICTS} of {verdicts} verdicts are shown."
