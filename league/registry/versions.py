"""Published versions and their notes. A version is visible only once it is ready."""

from collections.abc import Collection
from datetime import UTC, datetime
from pathlib import Path

from sqlalchemy import Select, func, select
from sqlalchemy.orm import Session

from league.errors import InvalidInput, NotPromotable, UnknownAlias, UnknownVersion, VersionRetired
from league.refs import CheckpointRef
from league.registry import leagues
from league.registry.storage.artifacts import ArtifactStore
from league.registry.storage.database import Database, Repository, as_method, reading, writing
from league.registry.storage.manifest import (
    EXPLOITER,
    MIXTURE,
    SEARCH,
    TRAINING,
    Manifest,
    Mixture,
    SearchSettings,
)
from league.registry.storage.rows import Note, VersionRow, VersionState
from league.registry.storage.tables import READY, AliasTable, VersionNoteTable, VersionTable

MAX_NOTE_LENGTH = 2000
"""Characters."""


def _get(session: Session, league: str, number: int) -> VersionRow:
    """Return one version. Raises UnknownLeague or UnknownVersion."""
    version = session.scalar(_ready(league).where(VersionTable.number == number))
    return _rows(session, league, [version])[0] if version else _unknown(session, league, number)


def resolve(session: Session, ref: CheckpointRef | str) -> VersionRow:
    """Return the version that a reference names now.

    Raises InvalidReference, UnknownLeague, UnknownVersion or UnknownAlias.
    """
    ref = CheckpointRef.parse(ref) if isinstance(ref, str) else ref
    if isinstance(ref.version, int):
        return _get(session, ref.league, ref.version)
    number = session.scalar(select(AliasTable.version).filter_by(league=ref.league, name=ref.version))
    if number is None:
        leagues.require(session, ref.league)
        names = session.scalars(select(AliasTable.name).filter_by(league=ref.league).order_by(AliasTable.name))
        known_names = ", ".join(names) or "none yet"
        raise UnknownAlias(f"league {ref.league} has no alias {ref.version!r}; known: {known_names}")
    return _get(session, ref.league, number)


def compositions(session: Session, league: str, numbers: Collection[int]) -> dict[int, Mixture | SearchSettings]:
    """Return the mixtures and the searches among some versions, which play with other versions; by one cheap query."""
    query = select(VersionTable.number, VersionTable.manifest).filter_by(league=league, state=READY)
    query = query.where(VersionTable.role.in_((MIXTURE, SEARCH)), VersionTable.number.in_(numbers))
    manifests = {number: _manifest(league, number, text) for number, text in session.execute(query)}
    return {number: one for number, manifest in manifests.items() if (one := manifest.mixture or manifest.search)}


class VersionRepository(Repository):
    """Reads published versions and their files, and writes notes."""

    def __init__(self, database: Database, artifacts: ArtifactStore) -> None:
        super().__init__(database)
        self._artifacts = artifacts

    get = as_method(_get)
    resolve = as_method(resolve)
    compositions = as_method(compositions)

    def with_files(self, ref: CheckpointRef) -> VersionRow:
        """Return the version that a reference names now. Raises VersionRetired, and what `resolve` raises."""
        version = self.resolve(ref)
        if version.retired_at is not None:
            _retired(version.league, version.number)
        return version

    def all(self, league: str) -> list[VersionRow]:
        """Return all versions of a league, oldest first. Raises UnknownLeague."""
        return self._list(league, _ready(league).order_by(VersionTable.number))

    def newest(self, league: str, *, before: int | None = None, limit: int = 20) -> list[VersionRow]:
        """Return at most `limit` versions of a league, newest first. Raises UnknownLeague.

        before: return only versions with a lower number.
        """
        query = _ready(league).order_by(VersionTable.number.desc()).limit(limit)
        if before is not None:
            query = query.where(VersionTable.number < before)
        return self._list(league, query)

    def exploiters(self, league: str, targets: Collection[str]) -> list[VersionRow]:
        """Return the exploiters of the versions `targets`, except retired ones, oldest first. Raises UnknownLeague."""
        query = _ready(league).where(VersionTable.exploits.in_(targets), VersionTable.retired_at.is_(None))
        return self._list(league, query.order_by(VersionTable.number))

    @reading
    def _list(self, session: Session, league: str, query: Select[VersionTable]) -> list[VersionRow]:
        return _rows(session, league, leagues.rows(session, league, query))

    @reading
    def exploiter_refs(self, session: Session, league: str) -> set[str]:
        """Return the references of all exploiters of a league, retired ones included. Does not read manifests."""
        query = select(VersionTable.number).where(VersionTable.league == league, VersionTable.exploits.is_not(None))
        return {f"{league}@{number}" for number in session.scalars(query)}

    @reading
    def numbers(self, session: Session, league: str | None = None) -> dict[str, list[int]]:
        """Return league → version numbers, ascending, of one league or of all that have versions.

        Retired versions are not included. Does not read manifests.
        """
        table = VersionTable
        query = (
            select(table.league, table.number)
            .filter_by(state=READY, retired_at=None)
            .order_by(table.league, table.number)
        )
        numbers: dict[str, list[int]] = {}
        for name, number in session.execute(query if league is None else query.filter_by(league=league)):
            numbers.setdefault(name, []).append(number)
        return numbers

    def states(self, keys: Collection[tuple[str, int]]) -> dict[tuple[str, int], VersionState | None]:
        """Return (league, number) → the state of a version, None if it was removed."""
        table = VersionTable
        query = select(table.league, table.number, table.sha256, table.retired_at.is_not(None))
        query = query.where(table.state == READY, table.league.in_({league for league, _ in keys}))
        query = query.where(table.number.in_({number for _, number in keys}))
        states = {(league, number): VersionState(*state) for league, number, *state in self._database.rows(query)}
        return {key: states.get(key) for key in keys}

    def copy(self, league: str, number: int, folder: str, target: Path) -> Path:
        """Copy a folder of a version to the new directory `target`, and return it.

        Raises ArtifactCorrupt, or VersionRetired if the version or this folder was removed.
        """
        manifest = self._artifacts.verify_names(league, number, self.with_files(CheckpointRef(league, number)).sha256)
        if not self._artifacts.has_folder(league, number, folder):
            raise VersionRetired(f"{league}@{number} has no {folder} state any more: `league retire` removed it")
        self._artifacts.copy(manifest, folder, target)
        return target

    def has_training(self, version: VersionRow) -> bool:
        """Return whether a version has the training state from which training continues."""
        return version.retired_at is None and self._artifacts.has_folder(version.league, version.number, TRAINING)

    @writing
    def set_note(self, session: Session, ref: CheckpointRef, text: str, *, actor: str) -> VersionRow:
        """Replace the note of a version; an empty text removes it.

        Raises UnknownLeague, UnknownVersion, UnknownAlias or InvalidInput.
        """
        text = text.strip()
        if len(text) > MAX_NOTE_LENGTH or "\0" in text:
            raise InvalidInput(
                f"a note must be at most {MAX_NOTE_LENGTH} characters without a zero byte, got {len(text)}"
            )
        version = resolve(session, ref)
        if text != (version.note.text if version.note else ""):
            note = VersionNoteTable(
                league=version.league, version=version.number, text=text, actor=actor, at=datetime.now(UTC)
            )
            session.add(note)
            session.flush()
        return _get(session, version.league, version.number)


def find_by_source(session: Session, league: str, source: str) -> int | None:
    """Return the number of the version that was published from the checkpoint `source`."""
    ready = select(VersionTable.number).filter_by(league=league, state=READY)
    return session.scalar(ready.where(VersionTable.source == source))


def require(session: Session, league: str, number: int) -> None:
    """Raise UnknownLeague or UnknownVersion unless the version is ready."""
    if session.scalar(select(VersionTable.number).filter_by(league=league, number=number, state=READY)) is None:
        _unknown(session, league, number)


def require_files(session: Session, league: str, number: int) -> None:
    """Raise UnknownLeague, UnknownVersion or VersionRetired unless the version is ready and has its files, as have its
    members if it is a mixture, and the version that it plays if it is a search version.
    """
    for version in (number, *sorted(members(session, league, [number]))):
        require(session, league, version)
        if session.get_one(VersionTable, (league, version)).retired_at is not None:
            _retired(league, version)


def require_promotable(session: Session, league: str, number: int) -> None:
    """Raise NotPromotable if the version is an exploiter. Raises what `require_files` raises."""
    require_files(session, league, number)
    version = session.get_one(VersionTable, (league, number))
    if version.role == EXPLOITER:
        raise NotPromotable(
            f"{league}@{number} has the role {EXPLOITER} (of {version.exploits}): it cannot be promoted"
        )


def members(session: Session, league: str, numbers: Collection[int]) -> set[int]:
    """Return the versions that the mixtures and search versions among some versions play with."""
    return {version for one in compositions(session, league, numbers).values() for version in one.versions}


def _manifest(league: str, number: int, text: str | None) -> Manifest:
    assert text is not None, "a ready version has a manifest"
    return Manifest.from_json(text, source=f"the manifest of {league}@{number}")


def _retired(league: str, number: int) -> None:
    raise VersionRetired(f"{league}@{number} was retired and its files were removed: use another version")


def _ready(league: str) -> Select[VersionTable]:
    return select(VersionTable).filter_by(league=league, state=READY)


def _unknown(session: Session, league: str, number: int) -> VersionRow:
    leagues.require(session, league)
    ready = select(VersionTable.number).filter_by(league=league, state=READY)
    last = session.scalar(ready.order_by(VersionTable.number.desc()).limit(1))
    newest = f"the newest is {last}" if last else "none is published yet: `league train CONFIG` publishes versions"
    raise UnknownVersion(f"league {league} has no version {number}; {newest}")


def _rows(session: Session, league: str, versions: list[VersionTable]) -> list[VersionRow]:
    if not versions:
        return []
    names: dict[int, list[str]] = {}
    for alias in session.scalars(select(AliasTable).filter_by(league=league).order_by(AliasTable.name)):
        names.setdefault(alias.version, []).append(alias.name)
    numbers, table = [version.number for version in versions], VersionNoteTable
    of_versions = (table.league == league) & table.version.between(min(numbers), max(numbers))
    newest = select(func.max(table.id)).where(of_versions).group_by(table.version)
    stored_notes = session.scalars(select(table).where(table.id.in_(newest), table.text != ""))
    notes = {note.version: Note(note.text, note.actor, note.at) for note in stored_notes}
    rows = []
    for version in versions:
        assert version.sha256 is not None, "a ready version has a digest"
        rows.append(
            VersionRow(
                league=league,
                number=version.number,
                source=version.source,
                sha256=version.sha256,
                manifest=_manifest(league, version.number, version.manifest),
                aliases=tuple(names.get(version.number, ())),
                note=notes.get(version.number),
                retired_at=version.retired_at,
            )
        )
    return rows
