"""Notes: what people write of a version, such as what was tried in it. The newest of a version is shown."""

from collections.abc import Collection
from datetime import UTC, datetime

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from league.errors import InvalidInput
from league.registry import rows
from league.registry.tables import VersionNote

LONGEST = 2000
"""Characters."""


def write(session: Session, league: str, version: int, text: str, actor: str) -> None:
    """Put a note in place of the one before; an empty one takes it away, the same again is the one that is there.

    Raises InvalidInput.
    """
    text = text.strip()
    if len(text) > LONGEST or "\0" in text:
        raise InvalidInput(f"a note must be at most {LONGEST} characters without a zero byte, got {len(text)}")
    before = current(session, league, [version]).get(version)
    if text == (before.text if before else ""):
        return
    session.add(VersionNote(league=league, version=version, text=text, actor=actor, at=datetime.now(UTC)))
    session.flush()


def current(session: Session, league: str, versions: Collection[int]) -> dict[int, rows.Note]:
    """version → its note, of those of `versions` that have one."""
    if not versions:
        return {}
    of_them = (VersionNote.league == league) & VersionNote.version.between(min(versions), max(versions))
    newest = select(func.max(VersionNote.id)).where(of_them).group_by(VersionNote.version)
    written = session.scalars(select(VersionNote).where(VersionNote.id.in_(newest), VersionNote.text != ""))
    return {note.version: rows.Note(note.text, note.actor, note.at) for note in written}
