"""Lists results of a league: matches from the ledger, the leaderboard, the payoff matrix and the rating history.

`game` names earlier conditions (`summary.earlier` of the league): results from before the game of the league, or the
selection of actions, changed. `computed_at` is the time of the last update, null before the first.
"""

from collections.abc import Sequence
from datetime import datetime
from typing import Any

from pydantic import Field

from league.conditions import Conditions
from league.errors import InvalidInput, UnknownMatch
from league.registry.registry import Registry
from league.registry.snapshots import SUMMARY, earlier_part
from league.registry.storage.manifest import SearchSettings
from league.results import records
from league.results.ledger import Ledger
from league.service_requests import GameForfeit
from serve_app.declaration import Declaration, Page, Response, integer, text
from serve_app.routes.documents import ComputedAt, Interval, Number, StoredDocument, StoredTime, VersionSearch

GAME = text(
    "game",
    "`name` of one of `earlier` in the summary of the league: the results of an earlier game.",
    "4f2a91c0b7de-greedy",
)


class MatchSummary(Response):
    """A match: two games in which the contestants swap sides."""

    match: str = Field(description="`schedule/position`")
    schedule: str
    position: int
    kind: str = Field(description="The kind of the schedule: `verdict`, `gauntlet`, `round_robin` …")
    contestants: tuple[str, str]
    scores: list[float] = Field(description="Sums over the games.")
    returns: list[float] | None = Field(description="Sums over the games; null if a game was forfeited.")
    counts: bool = Field(
        description="Whether the match is counted. False if its schedule was purged, or if it was another game: the"
        " environment, its code, or settings of play that decide results have changed since."
    )
    played_at: datetime


class ListedMatch(MatchSummary):
    """A match without its games."""

    games: int = Field(description="Number of games of each contestant.")


class MatchGame(Response):
    """A game of a match."""

    game: int
    sides: dict[str, str] = Field(description="Contestant by side.")
    members: dict[str, str] = Field(description="Version that played, by contestant that is a mixture.")
    scores: list[float | None] = Field(
        description="Score of each contestant; null if it did not take part, or if both were in one team."
    )
    returns: list[float | None]
    opening: int = Field(description="Number of opening actions.")
    actions: int = Field(description="Number of actions after the opening.")
    forfeits: list[GameForfeit]


class MatchWithGames(MatchSummary):
    """A match with its games."""

    league: str
    seed: int
    games: list[MatchGame]


class LeaderboardRow(StoredDocument):
    """A row of the leaderboard."""

    rank: int = Field(ge=1)
    ref: str
    rating: float | None = Field(description="Elo above `script:random`; null if no chain of games connects the two.")
    interval: Interval
    score: float = Field(ge=0, le=1)
    mean_return: float | None
    games: int
    unique_games: int | None
    search: VersionSearch | None = Field(description="The search of a search version.")


class Leaderboard(Response):
    """A page of the leaderboard, best first."""

    league: str
    computed_at: ComputedAt
    sides: list[str] = Field(description="Sides that have a separate leaderboard; empty if the sides are symmetric.")
    side: str | None
    leaderboard: list[LeaderboardRow]
    not_champion: str | None = Field(
        description="Why the best version by rating is not the champion, as a sentence; null if it is, and for the"
        " results of an earlier game."
    )
    total: int = Field(description="Total number of rows.")


class ContestantShares(StoredDocument):
    """The shares of a contestant in a population, with 95 % intervals."""

    ref: str
    alpha_rank: float = Field(description="Share of time in an imitating population.")
    alpha_rank_interval: Interval
    nash: float = Field(description="Probability in the maximum-entropy equilibrium.")
    nash_interval: Interval
    value: float = Field(description="Payoff against the equilibrium, from -1 to 1.")


class PayoffMatrix(StoredDocument):
    """A payoff matrix."""

    contestants: list[str]
    score: list[list[float | None]] = Field(
        description="`score[i][j]`: mean score of i against j; null if they have not played."
    )
    games: list[list[int]]
    by_side: dict[str, list[list[float | None]]] = Field(
        description="Scores by side: only games in which i alone played this side."
    )
    difference: list[list[Any]] = Field(description="Differences in mean return.")
    shares: list[ContestantShares] = Field(
        description="α-Rank and Nash averaging of the contestants that have all met; empty if fewer than three."
    )


class PayoffTable(Response):
    """The payoff matrix; null before the first game."""

    league: str
    computed_at: ComputedAt
    payoff: PayoffMatrix | None


class VersionRating(StoredDocument):
    """A version with its rating."""

    ref: str
    number: Number
    made_at: StoredTime
    steps: int
    parent: int | None
    rating: float | None
    interval: Interval
    games: int
    champion_at: list[StoredTime] = Field(description="The times at which it became champion.")


class Ratings(Response):
    """The versions with their ratings, oldest first."""

    league: str
    computed_at: ComputedAt
    versions: list[VersionRating]


@Declaration(
    "GET",
    "/v1/leagues/{league}/matches",
    Page("matches", ListedMatch, "match"),
    scope="read",
    tag="Results",
    parameters=(
        text("first", "A version or a script: `connect_four@3`, `script:random`."),
        text("second", "The other contestant."),
    ),
)
def matches(
    registry: Registry, league: str, limit: int, before: str | None, first: str | None, second: str | None
) -> Sequence[dict[str, Any]]:
    """List matches.

    Newest first. With `first` and `second` only the matches between these two contestants, in either order.
    """
    if (first is None) != (second is None):
        raise InvalidInput("first and second must be given together")
    pair = (first, second) if first is not None and second is not None else None
    entries = Ledger(registry).page(league, contestants=pair, before=before, limit=limit)
    current = registry.leagues.get(league).conditions
    return [_listed(entry, current) for entry in entries]


@Declaration(
    "GET",
    "/v1/leagues/{league}/matches/{schedule}/{position}",
    MatchWithGames,
    scope="read",
    tag="Results",
    errors=(UnknownMatch,),
)
def match(registry: Registry, league: str, schedule: str, position: str) -> dict[str, Any]:
    """Get a match with its games."""
    ledger, name = Ledger(registry), f"{schedule}/{position}"
    current = registry.leagues.get(league).conditions
    entry = ledger.entry(name)
    plan, played = ledger.scheduled_match(name)
    if played.league != league:
        raise UnknownMatch(f"league {league} has no match {name!r}")
    games = [_game(number, game, played, plan) for number, game in enumerate(played.games)]
    return _listed(entry, current) | {"league": league, "seed": played.seed, "games": games}


@Declaration(
    "GET",
    "/v1/leagues/{league}/leaderboard",
    Leaderboard,
    scope="read",
    tag="Results",
    parameters=(
        integer("limit", "Maximum number of rows.", largest=200, default=50),
        integer("offset", "Number of rows to skip.", smallest=0, default=0),
        text("side", "One of `sides`: count only the results on this side.", "player_0"),
        GAME,
    ),
)
def leaderboard(
    registry: Registry, league: str, limit: int, offset: int, side: str | None, game: str | None
) -> dict[str, Any]:
    """Get the leaderboard."""
    document, computed_at = _snapshot(registry, league, _part(registry, league, game, "leaderboard"))
    document = document or {"leaderboard": [], "by_side": {}}
    sides = list(document["by_side"])
    if side is not None and side not in sides:
        expected = (
            f"side must be one of {', '.join(sides)}" if sides else f"no side of {league} has its own leaderboard"
        )
        raise InvalidInput(f"{expected}, got {side!r}")
    every = document["leaderboard"] if side is None else document["by_side"][side]
    standings, prefix = every[offset : offset + limit], f"{league}@"
    numbers = [int(row["ref"].removeprefix(prefix)) for row in standings if row["ref"].startswith(prefix)]
    searches = {
        f"{prefix}{number}": one
        for number, one in registry.versions.compositions(league, numbers).items()
        if isinstance(one, SearchSettings)
    }
    page = [
        {"rank": offset + place, "search": searches.get(standing["ref"])} | standing
        for place, standing in enumerate(standings, 1)
    ]
    return {
        "league": league,
        "computed_at": computed_at,
        "sides": sides,
        "side": side,
        "leaderboard": page,
        "not_champion": document.get("not_champion"),
        "total": len(every),
    }


@Declaration("GET", "/v1/leagues/{league}/payoff", PayoffTable, scope="read", tag="Results", parameters=(GAME,))
def payoff(registry: Registry, league: str, game: str | None) -> dict[str, Any]:
    """Get the payoff matrix.

    Scores and games of the 40 best contestants against each other; null before the first game.
    """
    document, computed_at = _snapshot(registry, league, _part(registry, league, game, "payoff"))
    return {"league": league, "computed_at": computed_at, "payoff": document}


@Declaration("GET", "/v1/leagues/{league}/ratings", Ratings, scope="read", tag="Results")
def ratings(registry: Registry, league: str) -> dict[str, Any]:
    """Get ratings of all versions.

    The versions, oldest first, with their ratings and the times at which they became champion.
    """
    document, computed_at = _snapshot(registry, league, "ratings")
    return {"league": league, "computed_at": computed_at} | (document or {"versions": []})


def _listed(entry: records.LedgerEntry, current: Conditions) -> dict[str, Any]:
    result = entry.result
    return {
        "match": entry.id,
        "schedule": result.schedule,
        "position": result.position,
        "kind": entry.kind,
        "contestants": result.contestants,
        "scores": result.scores,
        "returns": result.returns,
        "games": result.games,
        "counts": not entry.is_purged and entry.conditions == current,
        "played_at": entry.played_at,
    }


def _game(number: int, game: records.Game, match: records.Match, schedule: records.Schedule) -> dict[str, Any]:
    who = match.contestants
    return {
        "game": number,
        "sides": {side: who[contestant] for side, contestant in zip(schedule.sides, game.sides, strict=True)},
        "members": {ref: member for ref, member in zip(who, match.acting(number), strict=True) if ref != member},
        "scores": game.scores,
        "returns": game.returns,
        "opening": len(game.opening),
        "actions": len(game.actions),
        "forfeits": [
            {"ref": who[forfeit.contestant], "agent": forfeit.agent, "reason": forfeit.reason}
            for forfeit in game.forfeits
        ],
    }


def _part(registry: Registry, league: str, game: str | None, part: str) -> str:
    """Name of the snapshot of current results, or of results of an earlier game."""
    if game is None:
        return part
    summary, _ = _snapshot(registry, league, SUMMARY)
    games = [earlier_game["name"] for earlier_game in (summary or {}).get("earlier", ())]
    if game not in games:
        expected = f"game must be one of {', '.join(games)}" if games else f"{league} has no results of an earlier game"
        raise InvalidInput(f"{expected}, got {game!r}")
    return earlier_part(game, part)


def _snapshot(registry: Registry, league: str, part: str) -> tuple[Any, datetime | None]:
    """A snapshot and its time; None before it was computed. Raises UnknownLeague."""
    snapshot = registry.snapshots.get(league, part)
    return (None, None) if snapshot is None else (snapshot.document, snapshot.at)
