"""Results under earlier conditions: before the game of a league changed, or the way in which versions select actions.

They count in no rating, payoff or verdict of the league, but stay viewable with tables of their own.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from evaluation.documents import iso_timestamp
from evaluation.matches.leaderboard import CountedGames
from evaluation.statistics.population import shares
from league.conditions import Conditions, GameChange, game_changes
from league.registry.registry import Registry
from league.registry.snapshots import FORMAT, earlier_part
from league.registry.storage.rows import LeagueRow
from league.results.ledger import Ledger


@dataclass(frozen=True, slots=True)
class EarlierResults:
    """Matches under earlier conditions.

    Attributes:
        conditions: Those of the matches.
        matches: Their number.
        changes: What of the game differs from the current one.
        actions_changed: Whether versions select actions in another way now.
        replaced_at: When the league had this game last; None if it still has it.
    """

    conditions: Conditions
    matches: int
    changes: tuple[GameChange, ...]
    actions_changed: bool
    replaced_at: datetime | None

    def to_json(self) -> dict[str, Any]:
        """Return a JSON document."""
        return {
            "name": self.conditions.name,
            "actions": self.conditions.actions,
            "matches": self.matches,
            "changes": [change._asdict() for change in self.changes],
            "actions_changed": self.actions_changed,
            "replaced_at": self.replaced_at and iso_timestamp(self.replaced_at),
        }


def earlier_results(registry: Registry, league: LeagueRow) -> list[EarlierResults]:
    """Return the earlier conditions under which a league has matches, newest first. Purged ones are left out."""
    ledger, games = Ledger(registry), {row.digest: row for row in registry.leagues.earlier_games(league.slug)}
    purged, played = ledger.purged(league.slug), ledger.counts(league.slug)
    matches: Counter[Conditions] = Counter()
    for schedule in ledger.schedules(league.slug):
        is_earlier = schedule.conditions != league.conditions and schedule.scoring != "team"
        if is_earlier and schedule.id not in purged and schedule.id in played:
            matches[schedule.conditions] += played[schedule.id]
    results = []
    for conditions, number in reversed(matches.items()):
        game = games.get(conditions.game_digest)  # None if only the selection of actions is another one
        results.append(
            EarlierResults(
                conditions=conditions,
                matches=number,
                changes=game_changes(game.game, league.game) if game else (),
                actions_changed=conditions.actions != league.conditions.actions,
                replaced_at=game.replaced_at if game else None,
            )
        )
    return results


def refresh_earlier_results(registry: Registry, league: str) -> None:
    """Recompute the stale tables of results under earlier conditions. Raises UnknownLeague."""
    row, marks = registry.leagues.get(league), registry.snapshots.marks(league)
    for results in earlier_results(registry, row):
        name, mark = results.conditions.name, f"{FORMAT}; {results.matches} matches; {row.interface_digest}"
        if marks.get(earlier_part(name, "leaderboard")) == mark:
            continue
        played = CountedGames(registry, row, conditions=results.conditions)
        documents = tables(played, list(row.interface.sides))
        registry.snapshots.put(league, {earlier_part(name, part): table for part, table in documents.items()}, mark)


def tables(played: CountedGames, sides: Sequence[str], not_champion: str | None = None) -> dict[str, Any]:
    """Return the documents `leaderboard` and `payoff` of some games.

    not_champion: why the best version is not the champion. None for earlier conditions: the champion is that of the
    current ones.
    """
    payoff = played.payoff()
    return {
        "leaderboard": {
            "sides": list(sides),
            "leaderboard": [standing.to_json() for standing in played.leaderboard],
            "by_side": {
                side: [standing.to_json() for standing in standings] for side, standings in played.by_side().items()
            },
            "not_champion": not_champion,
        },
        "payoff": payoff
        and payoff.to_json() | {"shares": [share.to_json() for share in shares(payoff, played.matches)]},
    }
