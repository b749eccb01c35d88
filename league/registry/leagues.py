"""Registered leagues. The row of a league is the lock that serialises all changes to the league."""

import json
import logging
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import ValidationError
from sqlalchemy import Select, select, tuple_
from sqlalchemy.orm import InstrumentedAttribute, Session

from league.conditions import ActionSelection, Conditions, action_selection, default_selection, game_changes
from league.errors import InterfaceChanged, InvalidInput, UnknownLeague, did_you_mean
from league.interface import Interface, digest
from league.refs import check_new
from league.registry.storage import change_counter
from league.registry.storage.database import Repository, insert, reading, upsert, writing
from league.registry.storage.rows import EarlierGameRow, KeyRow, LeagueRow
from league.registry.storage.tables import READY, MatchTable, ScheduleTable, VersionTable

if TYPE_CHECKING:
    from collections.abc import Callable

    from league.config.league import LeagueConfig


Row = TypeVar("Row")
logger = logging.getLogger(__name__)


class LeagueRepository(Repository):
    """Registers and reads leagues."""

    @writing
    def register(self, session: Session, config: "LeagueConfig", interface: Interface) -> None:
        """Add a league or update its configuration. Warns if results exist and what decides them has changed: the game,
        or how versions select actions.

        Raises LeagueArchived, InvalidReference for a new name that begins with `-`, or InterfaceChanged if published
        versions have another interface.
        """
        values: dict[str, Any] = {
            "config": config.model_dump(mode="json", by_alias=True),
            "interface": interface.model_dump(mode="json"),
            "interface_digest": interface.digest(),
            "environment_digest": config.environment.digest(),
            "game": (game := config.game()),
            "game_digest": digest(game),
        }
        first = {"slug": config.league, "last_version": 0, "registered_at": datetime.now(UTC)}
        if session.get(LeagueRow, config.league) is None:
            check_new("league", config.league)
        if insert(session, LeagueRow, [first | values]):
            change_counter.count(session, "leagues")
            _end_keys(session, config.league)
            return
        row = lock_active(session, config.league)
        ready = select(VersionTable.number).filter_by(league=config.league, state=READY).limit(1)
        if row.interface_digest != values["interface_digest"] and session.scalar(ready) is not None:
            raise InterfaceChanged(
                f"league {config.league} has versions with other spaces or policies than this configuration: "
                "keep them, or register the configuration under a new league name"
            )
        before, selection = _action_selections(session, row.slug)[row.slug], action_selection(config, interface)
        changes = [f"how versions select actions has changed: {before} → {selection}"] if before != selection else []
        if changes:
            change_counter.count(session, "leagues")
        if row.game_digest != values["game_digest"]:
            changes.insert(0, _describe_changes(row.game, game))
            # Also without results: a match of a schedule that is open may still be recorded.
            earlier = {"game": row.game, "replaced_at": datetime.now(UTC)}
            upsert(session, EarlierGameRow, {"league": row.slug, "digest": row.game_digest}, earlier)
        if changes and _has_results(session, row.slug):
            is_back = _has_results(session, row.slug, Conditions(digest(game), selection))
            logger.warning(
                "league %s: %s. %s results can be viewed, but no longer count in ratings, payoffs and verdicts.%s",
                row.slug,
                "; ".join(changes),
                "Later" if is_back else "Earlier",
                " The results from when the league last had this game count again." if is_back else "",
            )
        row.config_document, row.interface_document = values.pop("config"), values.pop("interface")
        for name, value in values.items():
            setattr(row, name, value)

    @reading
    def get(self, session: Session, league: str) -> LeagueRow:
        """Return one league. Raises UnknownLeague."""
        return session.get(LeagueRow, league) or _unknown(session, league)

    @reading
    def earlier_games(self, session: Session, league: str) -> list[EarlierGameRow]:
        """Return the other games that the league had, newest first. Raises UnknownLeague."""
        table = EarlierGameRow
        query = select(table).filter_by(league=league).order_by(table.replaced_at.desc(), table.digest)
        row = session.get(LeagueRow, league) or _unknown(session, league)
        return list(session.scalars(query.where(table.digest != row.game_digest)))

    def unregistered_change(self, league: str) -> str | None:
        """Describe how the game of a league has changed since it was registered, whose results still count.

        None if it has not, or if the code of its environment is not on this machine. Raises UnknownLeague.
        """
        row = self.get(league)
        if not row.config.environment.has_code() or row.config.game_digest() == row.game_digest:
            return None
        return _describe_changes(row.game, row.config.game())

    def follow_code(self, league: str, describe: "Callable[[LeagueConfig], Interface]") -> LeagueRow:
        """Return one league, registered again if the code of its environment has changed.

        describe: creates the environment and returns its interface. Raises UnknownLeague, InterfaceChanged, and the
        errors of `describe`; then nothing is changed.
        """
        row = self.get(league)
        if row.config.game_digest() == row.game_digest:
            return row
        self.register(row.config, describe(row.config))
        return self.get(league)

    @writing
    def archive(self, session: Session, league: str, undo: bool = False) -> LeagueRow:
        """Archive a league, or make it active again. Idempotent. Raises UnknownLeague."""
        row = lock(session, league)
        row.archived_at = None if undo else row.archived_at or datetime.now(UTC)
        return row

    @reading
    def names(self, session: Session) -> dict[str, datetime | None]:
        """Return league → since when it is archived, sorted by name. Does not read configurations."""
        query = select(LeagueRow.slug, LeagueRow.archived_at).order_by(LeagueRow.slug)
        return dict(session.execute(query).tuples().all())

    @reading
    def action_selections(self, session: Session) -> dict[str, ActionSelection]:
        """Return league → how its versions select actions. Does not read the rest of the configurations."""
        return _action_selections(session)

    @reading
    def policy_ids(self, session: Session) -> dict[str, tuple[str, ...]]:
        """Return league → ids of its policies, sorted by name. Does not read configurations, of which one may be from
        another release. Leaves out leagues whose interface is.
        """
        query = select(LeagueRow.slug, LeagueRow.interface_document).order_by(LeagueRow.slug)
        policy_ids = {}
        for league, interface in session.execute(query):
            with suppress(ValidationError):
                policy_ids[league] = Interface.model_validate(interface).policy_ids
        return policy_ids


def require(session: Session, league: str) -> None:
    """Raise UnknownLeague, which lists the known leagues, unless the league is registered."""
    if session.scalar(select(LeagueRow.slug).filter_by(slug=league)) is None:
        _unknown(session, league)


def rows(session: Session, league: str, query: Select[Row]) -> list[Row]:
    """Return the rows of a query about a league. Raises UnknownLeague."""
    require(session, league)
    return list(session.scalars(query))


def newest(
    session: Session,
    league: str,
    table: type[Row],
    *,
    what: str,
    key: Sequence[InstrumentedAttribute[Any]],
    before: str | None,
    limit: int,
) -> list[Row]:
    """Return at most `limit` rows of a league, newest first.

    what: a row, in words. key: columns that sort rows by age. before: return only rows older than that with this id.
    Raises UnknownLeague, or InvalidInput if the league has no row `before`.
    """
    require(session, league)
    query = select(table).filter_by(league=league).order_by(*(column.desc() for column in key)).limit(limit)
    if before is not None:
        last = session.execute(select(*key).filter_by(league=league, id=before)).first()
        if last is None:
            raise InvalidInput(f"before: league {league} has no {what} {before!r}")
        query = query.where(tuple_(*key) < tuple(last))
    return list(session.scalars(query))


def lock(session: Session, league: str) -> LeagueRow:
    """Lock a league until the transaction ends. Raises UnknownLeague.

    Rows that only refer to the league can still be inserted (key_share). On SQLite the transaction is the lock.
    """
    return session.get(LeagueRow, league, with_for_update={"key_share": True}) or _unknown(session, league)


def lock_active(session: Session, league: str) -> LeagueRow:
    """Lock a league until the transaction ends. Raises UnknownLeague or LeagueArchived."""
    row = lock(session, league)
    row.require_active()
    return row


def _end_keys(session: Session, league: str) -> None:
    """End the validity of keys for a removed league of this name: this one is another."""
    query = select(KeyRow).where(KeyRow.revoked_at.is_(None)).with_for_update()
    for key in session.scalars(query):
        if key.leagues is None or league not in key.leagues:
            continue
        change_counter.count(session, "keys")
        if other_leagues := key.leagues - {league}:
            key.leagues = other_leagues
        else:
            key.revoked_at = datetime.now(UTC)


def _action_selections(session: Session, league: str | None = None) -> dict[str, ActionSelection]:
    """league → action selection, of all leagues or of one."""
    configured_actions, interface = (
        LeagueRow.config_document["play"]["actions"].as_string(),
        LeagueRow.interface_document,
    )
    hidden, simultaneous = (interface[key].as_boolean() for key in ("hidden_information", "simultaneous"))
    query = select(LeagueRow.slug, configured_actions, hidden, simultaneous, interface["sides"])
    rows = session.execute(query if league is None else query.where(LeagueRow.slug == league))
    return {
        slug: actions or default_selection(bool(is_hidden or at_once), len(sides or ()))
        for slug, actions, is_hidden, at_once, sides in rows
    }


def _has_results(session: Session, league: str, conditions: Conditions | None = None) -> bool:
    """Whether a league has matches, played under `conditions` if given."""
    played = select(MatchTable.position).where(MatchTable.schedule == ScheduleTable.id)
    query = select(ScheduleTable.document).filter_by(league=league).where(played.exists())
    if conditions is None:
        return session.scalar(query.limit(1)) is not None
    schedules = map(json.loads, session.scalars(query.where(ScheduleTable.document.contains(conditions.game_digest))))
    return any((schedule["game_digest"], schedule["actions"]) == conditions for schedule in schedules)


def _describe_changes(before: dict[str, Any], now: dict[str, Any]) -> str:
    """Describe the differences of two games."""
    return "the game has changed: " + ", ".join(
        f"{change.name} {change.before} → {change.now}" for change in game_changes(before, now)
    )


def _unknown(session: Session, league: str) -> LeagueRow:
    slugs = list(session.scalars(select(LeagueRow.slug).order_by(LeagueRow.slug)))
    guess = did_you_mean(league, slugs)
    raise UnknownLeague(f"there is no league {league!r}{guess or '; known: ' + (', '.join(slugs) or 'none yet')}")
