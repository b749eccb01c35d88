"""How a version comes to be: reserved, written, made ready; or cleared away, whenever its publisher stops.

    reserve → (files staged, manifest, rename) → finish          the version is ready
            ↘ abandon → files removed → forget                   there never was one

A row leaves `publishing` once, by `finish` or by `abandon`, so that files are removed only when it can no
longer become ready. A crash at any point leaves a row that `stale` finds later.
"""

import hashlib
from datetime import UTC, datetime

from sqlalchemy import delete, select, update
from sqlalchemy.orm import Session

from league.errors import EnvironmentMismatch, InterfaceChanged, StorageError
from league.registry import leagues, versions
from league.registry.database import affected
from league.registry.manifest import Manifest
from league.registry.publisher import is_gone, this_process
from league.registry.tables import ABANDONED, PUBLISHING, READY, Version


def reserve(session: Session, league: str, source: str, parent: int | None, above: int) -> int:
    """Take the next number `above` that one. Raises UnknownLeague, or UnknownVersion of the parent."""
    row = leagues.lock(session, league)
    if parent is not None:
        versions.require(session, league, parent)
    row.last_version = max(row.last_version, above) + 1
    session.add(
        Version(
            league=league,
            number=row.last_version,
            state=PUBLISHING,
            source=source,
            parent=parent,
            publisher=this_process(),
            reserved_at=datetime.now(UTC),
        )
    )
    return row.last_version


def check(manifest: Manifest, league: str, number: int, parent: int | None) -> None:
    """Raise EnvironmentMismatch if a manifest is not of the version that was reserved."""
    found = (manifest.league, manifest.version, manifest.parent)
    if found != (league, number, parent):
        raise EnvironmentMismatch(
            f"the manifest is of {manifest.league}@{manifest.version} with parent {manifest.parent}, "
            f"expected {league}@{number} with parent {parent}"
        )


def finish(session: Session, manifest: Manifest, text: str, source: str) -> int:
    """Make a version ready, `text` being its manifest.json, unless another of the same source was faster.

    Returns the number of the one that is ready. Raises InterfaceChanged if its league has another interface.
    """
    row = leagues.lock(session, manifest.league)
    if row.interface_digest != manifest.interface.digest():
        raise InterfaceChanged(f"version {manifest.version} has other spaces or policies than league {manifest.league}")
    if (faster := versions.of_source(session, manifest.league, source)) is not None:
        return faster
    values = {"state": READY, "manifest": text, "sha256": hashlib.sha256(text.encode()).hexdigest()}
    if not _leave_publishing(session, manifest.league, manifest.version, values):
        raise StorageError(f"{manifest.league}@{manifest.version} took so long that it was cleared away")
    return manifest.version


def abandon(session: Session, league: str, number: int) -> bool:
    """Give a reservation up. False if it is ready or already given up."""
    return _leave_publishing(session, league, number, {"state": ABANDONED})


def forget(session: Session, league: str, number: int) -> None:
    """Remove the row of an abandoned version whose files are gone."""
    session.execute(delete(Version).filter_by(league=league, number=number, state=ABANDONED))


def stale(session: Session, league: str) -> list[int]:
    """Abandon what no living process will finish; returns those and the abandoned ones still there."""
    unfinished = session.scalars(select(Version).filter_by(league=league).where(Version.state != READY))
    numbers = []
    for version in unfinished:
        if version.state == PUBLISHING and not is_gone(version.publisher, version.reserved_at):
            continue
        version.state = ABANDONED
        numbers.append(version.number)
    return numbers


def _leave_publishing(session: Session, league: str, number: int, values: dict[str, str]) -> bool:
    statement = update(Version).filter_by(league=league, number=number, state=PUBLISHING).values(**values)
    return affected(session, statement) == 1
