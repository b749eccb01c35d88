"""Registered leagues. The row of a league is the lock that orders all changes below it."""

from datetime import UTC, datetime

from sqlalchemy import select
from sqlalchemy.orm import Session

from league.config import LeagueConfig
from league.errors import InterfaceChanged, UnknownLeague
from league.interface import Interface
from league.registry.database import insert
from league.registry.rows import LeagueRow
from league.registry.tables import READY, League, Version


def register(session: Session, config: LeagueConfig, interface: Interface) -> None:
    """Insert a league or renew its configuration. Raises InterfaceChanged if versions have another."""
    values = {
        "config": config.model_dump(mode="json", by_alias=True),
        "interface": interface.model_dump(mode="json"),
        "interface_digest": interface.digest(),
        "environment_digest": config.environment.digest(),
    }
    first = {"slug": config.league, "last_version": 0, "registered_at": datetime.now(UTC)}
    if insert(session, League, [first | values]):
        return
    known = lock(session, config.league)
    if known.interface_digest != values["interface_digest"] and _has_versions(session, config.league):
        raise InterfaceChanged(
            f"league {config.league} has versions with other spaces or policies than this configuration: "
            "keep them, or give the new league a name of its own"
        )
    for name, value in values.items():
        setattr(known, name, value)


def get(session: Session, slug: str) -> LeagueRow:
    """One league. Raises UnknownLeague, which lists the known ones."""
    return _row(session.get(League, slug) or _unknown(session, slug))


def every(session: Session) -> list[LeagueRow]:
    """All leagues by name."""
    return [_row(league) for league in session.scalars(select(League).order_by(League.slug))]


def require(session: Session, slug: str) -> None:
    """Raise UnknownLeague unless the league is registered."""
    if session.scalar(select(League.slug).filter_by(slug=slug)) is None:
        _unknown(session, slug)


def lock(session: Session, slug: str) -> League:
    """Hold a league until the transaction ends: nobody else changes what is below it. Raises UnknownLeague.

    Rows that merely refer to it may be inserted meanwhile (key_share). On SQLite the transaction is the lock.
    """
    return session.get(League, slug, with_for_update={"key_share": True}) or _unknown(session, slug)


def _has_versions(session: Session, slug: str) -> bool:
    ready = select(Version.number).filter_by(league=slug, state=READY)
    return session.scalar(ready.limit(1)) is not None


def _unknown(session: Session, slug: str) -> League:
    known = ", ".join(session.scalars(select(League.slug).order_by(League.slug)))
    raise UnknownLeague(f"there is no league {slug!r}; known: {known or 'none yet'}")


def _row(league: League) -> LeagueRow:
    return LeagueRow(
        slug=league.slug,
        config=LeagueConfig.from_mapping(league.config, source=f"the registered league {league.slug}"),
        interface=Interface.model_validate(league.interface),
        interface_digest=league.interface_digest,
        environment_digest=league.environment_digest,
        registered_at=league.registered_at,
    )
