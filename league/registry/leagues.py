"""Registered leagues. The row of a league is the lock that serialises all changes to the league."""

import logging
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from league.errors import InterfaceChanged, UnknownLeague
from league.interface import Interface, digest
from league.registry.storage.database import Repository, insert
from league.registry.storage.rows import LeagueRow, detached
from league.registry.storage.tables import READY, LeagueTable, MatchTable, VersionTable

if TYPE_CHECKING:
    from league.config.league import LeagueConfig


logger = logging.getLogger(__name__)


class LeagueRepository(Repository):
    """Registers and reads leagues."""

    def register(self, config: "LeagueConfig", interface: Interface) -> None:
        """Add a league or update its configuration. Warns if results exist and what decides them has changed.

        Raises InterfaceChanged if published versions have another interface.
        """
        values = {
            "config": config.model_dump(mode="json", by_alias=True),
            "interface": interface.model_dump(mode="json"),
            "interface_digest": interface.digest(),
            "environment_digest": config.environment.digest(),
            "game": (game := config.game()),
            "game_digest": digest(game),
        }
        first = {"slug": config.league, "last_version": 0, "registered_at": datetime.now(UTC)}
        with self._database.write() as session:
            if insert(session, LeagueTable, [first | values]):
                return
            known = lock(session, config.league)
            if known.interface_digest != values["interface_digest"] and _has_versions(session, config.league):
                raise InterfaceChanged(
                    f"league {config.league} has versions with other spaces or policies than this configuration: "
                    "keep them, or register the configuration under a new league name"
                )
            if known.game_digest != values["game_digest"] and _has_results(session, config.league):
                logger.warning(
                    "league %s: %s. Earlier results can be viewed, but no longer count in ratings, payoffs and"
                    " verdicts.",
                    config.league,
                    _changes(known.game, game),
                )
            for name, value in values.items():
                setattr(known, name, value)

    def get(self, league: str) -> LeagueRow:
        """Return one league. Raises UnknownLeague."""
        with self._database.read() as session:
            return _row(session.get(LeagueTable, league) or _unknown(session, league))

    def follow_code(self, league: str) -> LeagueRow:
        """Return one league, registered again if the code of its environment has changed. Raises UnknownLeague."""
        row = self.get(league)
        if row.config.game_digest() == row.game_digest:
            return row
        self.register(row.config, row.interface)
        return self.get(league)

    def all(self) -> list[LeagueRow]:
        """Return all leagues, sorted by name."""
        with self._database.read() as session:
            return [_row(league) for league in session.scalars(select(LeagueTable).order_by(LeagueTable.slug))]


def require(session: Session, league: str) -> None:
    """Raise UnknownLeague, which lists the known leagues, unless the league is registered."""
    if session.scalar(select(LeagueTable.slug).filter_by(slug=league)) is None:
        _unknown(session, league)


def lock(session: Session, league: str) -> LeagueTable:
    """Lock a league until the transaction ends. Raises UnknownLeague.

    Rows that only refer to the league can still be inserted (key_share). On SQLite the transaction is the lock.
    """
    return session.get(LeagueTable, league, with_for_update={"key_share": True}) or _unknown(session, league)


def _has_versions(session: Session, league: str) -> bool:
    ready = select(VersionTable.number).filter_by(league=league, state=READY)
    return session.scalar(ready.limit(1)) is not None


def _has_results(session: Session, league: str) -> bool:
    return session.scalar(select(MatchTable.position).filter_by(league=league).limit(1)) is not None


def _changes(before: dict[str, Any], now: dict[str, Any]) -> str:
    """Describe the differences of two games. Digests are abbreviated."""
    if not before:
        return "what decides results (the environment's code, its libraries, the rules of play) was not recorded before"
    names = [name for name in before | now if before.get(name) != now.get(name)]
    return "the game has changed: " + ", ".join(
        f"{name} {str(before.get(name))[:12]} → {str(now.get(name))[:12]}" for name in names
    )


def _unknown(session: Session, league: str) -> LeagueTable:
    known = ", ".join(session.scalars(select(LeagueTable.slug).order_by(LeagueTable.slug)))
    raise UnknownLeague(f"there is no league {league!r}; known: {known or 'none yet'}")


def _row(league: LeagueTable) -> LeagueRow:
    from league.config.league import LeagueConfig  # Takes 0.05 s to import, and most commands read versions only.

    config = LeagueConfig.from_mapping(league.config, source=f"the registered league {league.slug}")
    return detached(LeagueRow, league, config=config, interface=Interface.model_validate(league.interface))
