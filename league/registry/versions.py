"""Versions that are ready: the only ones that exist for anybody but their publisher."""

from sqlalchemy import Select, select
from sqlalchemy.orm import Session

from league.errors import UnknownAlias, UnknownVersion
from league.refs import CheckpointRef
from league.registry import leagues, notes
from league.registry.manifest import Manifest
from league.registry.rows import Note, VersionRow
from league.registry.tables import READY, Alias, Version


def get(session: Session, league: str, number: int) -> VersionRow:
    """One version. Raises UnknownLeague or UnknownVersion."""
    version = session.scalar(_ready(league).where(Version.number == number))
    return _rows(session, league, [version])[0] if version else _unknown(session, league, number)


def every(session: Session, league: str) -> list[VersionRow]:
    """All versions of a league, ascending. Raises UnknownLeague."""
    leagues.require(session, league)
    return _rows(session, league, list(session.scalars(_ready(league).order_by(Version.number))))


def newest(session: Session, league: str, before: int | None, limit: int) -> list[VersionRow]:
    """Those of a league, newest first, at most `limit`, of those with a lower number than `before`.

    Raises UnknownLeague.
    """
    leagues.require(session, league)
    query = _ready(league).order_by(Version.number.desc()).limit(limit)
    if before is not None:
        query = query.where(Version.number < before)
    return _rows(session, league, list(session.scalars(query)))


def numbers(session: Session, league: str | None) -> dict[str, list[int]]:
    """league → numbers of its versions, ascending: of one league or of all. Their manifests are not read."""
    query = select(Version.league, Version.number).filter_by(state=READY).order_by(Version.league, Version.number)
    found: dict[str, list[int]] = {}
    for name, number in session.execute(query if league is None else query.filter_by(league=league)):
        found.setdefault(name, []).append(number)
    return found


def of_source(session: Session, league: str, source: str) -> int | None:
    """The number of the version that was made from the checkpoint `source`."""
    return session.scalar(select(Version.number).filter_by(league=league, state=READY).where(Version.source == source))


def resolve(session: Session, ref: CheckpointRef) -> VersionRow:
    """The version that a reference names now. Raises UnknownLeague, UnknownVersion or UnknownAlias."""
    if isinstance(ref.version, int):
        return get(session, ref.league, ref.version)
    number = session.scalar(select(Alias.version).filter_by(league=ref.league, name=ref.version))
    if number is None:
        leagues.require(session, ref.league)
        names = session.scalars(select(Alias.name).filter_by(league=ref.league).order_by(Alias.name))
        known = ", ".join(names) or "none yet"
        raise UnknownAlias(f"league {ref.league} has no alias {ref.version!r}; known: {known}")
    return get(session, ref.league, number)


def require(session: Session, league: str, number: int) -> None:
    """Raise UnknownLeague or UnknownVersion unless the version is ready."""
    if session.scalar(select(Version.number).filter_by(league=league, number=number, state=READY)) is None:
        _unknown(session, league, number)


def _ready(league: str) -> Select[Version]:
    return select(Version).filter_by(league=league, state=READY)


def _unknown(session: Session, league: str, number: int) -> VersionRow:
    leagues.require(session, league)
    last = session.scalar(
        select(Version.number).filter_by(league=league, state=READY).order_by(Version.number.desc()).limit(1)
    )
    newest = f"the newest is {last}" if last else "none is published yet"
    raise UnknownVersion(f"league {league} has no version {number}; {newest}")


def _rows(session: Session, league: str, versions: list[Version]) -> list[VersionRow]:
    names: dict[int, list[str]] = {}
    for alias in session.scalars(select(Alias).filter_by(league=league).order_by(Alias.name)):
        names.setdefault(alias.version, []).append(alias.name)
    written = notes.current(session, league, [version.number for version in versions])
    return [_row(version, tuple(names.get(version.number, ())), written.get(version.number)) for version in versions]


def _row(version: Version, aliases: tuple[str, ...], note: Note | None) -> VersionRow:
    assert version.manifest is not None, "a version is ready with its manifest"
    assert version.sha256 is not None, "and its digest"
    manifest = Manifest.from_json(version.manifest, source=f"the manifest of {version.league}@{version.number}")
    return VersionRow(
        league=version.league,
        number=version.number,
        source=version.source,
        sha256=version.sha256,
        manifest=manifest,
        aliases=aliases,
        note=note,
    )
