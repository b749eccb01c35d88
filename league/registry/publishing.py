"""Publishes versions atomically and removes what interrupted publications leave.

    reserve → (files staged, manifest, rename) → finish          the version is ready
            ↘ abandon → files removed → forget                   the version never existed

A row leaves the state `publishing` once, by `finish` or by `abandon`, so files are removed only when the version can no
longer become ready. A crash at any point leaves a row that `sweep` finds later.
"""

import hashlib
from collections.abc import Callable, Mapping
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path

from sqlalchemy import delete, select, update
from sqlalchemy.orm import Session

from league.errors import (
    EnvironmentMismatch,
    InterfaceChanged,
    NotPromotable,
    StorageError,
    VersionRetired,
)
from league.files import DISK_FULL_OR_READ_ONLY, disk_errors
from league.registry import leagues, versions
from league.registry.processes import has_ended, this_process
from league.registry.storage.artifacts import ArtifactStore
from league.registry.storage.database import Database, Repository, row_count, writing
from league.registry.storage.manifest import (
    EXPLOITER,
    MIXTURE,
    SEARCH,
    Manifest,
    Member,
    Mixture,
    Role,
    SearchRule,
    SearchSettings,
    normalised,
)
from league.registry.storage.rows import LeagueRow, VersionRow
from league.registry.storage.tables import ABANDONED, PUBLISHING, READY, VersionTable
from league.registry.versions import VersionRepository

PUBLICATION_TIMEOUT = timedelta(days=1)
"""After this, a process on another machine is considered dead. Publishing takes seconds to minutes."""
Build = Callable[[Path, int], Manifest]
"""Writes the files of version `number` into a directory and returns its manifest, without digests."""


class VersionPublisher(Repository):
    """Publishes versions: reserves a number, writes the files, makes the version ready."""

    def __init__(self, database: Database, artifacts: ArtifactStore) -> None:
        super().__init__(database)
        self._artifacts = artifacts
        self._versions = VersionRepository(database, artifacts)

    def publish(self, league: str, build: Build, *, source: str, parent: int | None = None) -> VersionRow:
        """Publish the files that `build` writes as the next version, completely or not at all.

        source: identifies the checkpoint. If it was published before, the existing version is returned.
        Raises UnknownLeague, LeagueArchived, UnknownVersion (of the parent), InterfaceChanged, and what `build` raises.
        """
        self.sweep(league)
        with self._database.write() as session:
            leagues.lock(session, league)
            if (ready := versions.find_by_source(session, league, source)) is None:
                number = reserve(session, league, source, parent, above=self._artifacts.last(league))
        if ready is None:
            try:
                staging = self._artifacts.stage(league, number)
                with disk_errors(staging, only=DISK_FULL_OR_READ_ONLY):
                    manifest = build(staging, number)
                check(manifest, league, number, parent)
                text = self._artifacts.commit(manifest)
                with self._database.write() as session:
                    ready = finish(session, manifest, text, source)
            finally:
                with suppress(StorageError):  # otherwise, a later sweep removes it
                    if self._abandon(league, number):
                        self._clear(league, number)
        return self._versions.get(league, ready)

    def publish_mixture(self, league: str, shares: Mapping[int, float]) -> VersionRow:
        """Publish a mixture, or return the version that has these members and probabilities already.

        Whatever refers to a version can therefore refer to a mixture: aliases and their history, verdicts, schedules,
        canaries.

        Args:
            league: The league.
            shares: Version → probability. They must sum to 1 within TOLERANCE, and are normalised.

        Raises:
            UnknownLeague: The league does not exist.
            UnknownVersion: A member does not exist.
            VersionRetired: A member has no files any more.
            NotPromotable: A member is an exploiter.
            EnvironmentMismatch: A member has another interface or environment than the league or the other members.
            InvalidInput: The probabilities do not sum to 1, there are fewer than two members, or one is a mixture.
        """
        probabilities = normalised(shares)
        members = [self._versions.get(league, number) for number in probabilities]
        with self._database.read() as session:
            interface_digest = session.get_one(LeagueRow, league).interface_digest
        for member in members:
            _check_base(member, interface_digest)
            if member.role == EXPLOITER:
                raise NotPromotable(
                    f"{member.ref} has the role {EXPLOITER} (of {member.exploits}): it cannot be in a mixture"
                )
            if member.manifest.environment_digest != members[0].manifest.environment_digest:
                raise EnvironmentMismatch(
                    f"{members[0].ref} and {member.ref} were trained in different environments: they cannot be in one "
                    "mixture"
                )
        mixture = Mixture(
            members=tuple(
                Member(version=member.number, probability=probabilities[member.number], sha256=member.sha256)
                for member in members
            )
        )
        source = "mixture/" + ",".join(f"{number}:{probability!r}" for number, probability in probabilities.items())
        steps = max(member.steps for member in members)
        return self._publish_without_policies(members[0].manifest, MIXTURE, source, steps, mixture=mixture)

    def publish_search(self, league: str, number: int, rule: SearchRule, simulations: int, ms: float) -> VersionRow:
        """Publish a version that plays version `number` with a search, or return the one that does so already.

        ms: see SearchSettings.

        Raises:
            UnknownLeague: The league does not exist.
            UnknownVersion: The version does not exist.
            VersionRetired: It has no files any more.
            EnvironmentMismatch: It has another interface than the league.
            InvalidInput: It is a mixture or a search version.
        """
        base = self._versions.get(league, number)
        with self._database.read() as session:
            _check_base(base, session.get_one(LeagueRow, league).interface_digest)
        search = SearchSettings(version=number, sha256=base.sha256, rule=rule, simulations=simulations, ms=ms)
        source = f"search/{number}:{rule}:{simulations}"
        return self._publish_without_policies(base.manifest, SEARCH, source, base.steps, search=search)

    def _publish_without_policies(
        self,
        first: Manifest,
        role: Role,
        source: str,
        steps: int,
        *,
        mixture: Mixture | None = None,
        search: SearchSettings | None = None,
    ) -> VersionRow:
        """Publish a version that others play. first: of one of them."""

        def build(_: Path, number: int) -> Manifest:
            return Manifest(
                league=first.league,
                version=number,
                created_at=datetime.now(UTC),
                interface=first.interface,
                policies={},
                environment=first.environment,
                environment_digest=first.environment_digest,
                algorithm=role,
                settings={},
                seed=0,
                steps=steps,
                role=role,
                mixture=mixture,
                search=search,
                stack={},
            )

        return self.publish(first.league, build, source=source)

    def sweep(self, league: str) -> None:
        """Remove what publishers that died have left."""
        for number in self._stale(league):
            self._clear(league, number)

    def _clear(self, league: str, number: int) -> None:
        self._artifacts.discard(league, number)
        self._forget(league, number)

    @writing
    def _abandon(self, session: Session, league: str, number: int) -> bool:
        """Give up a reservation. False if it is ready or already abandoned."""
        return _leave_publishing(session, league, number, {"state": ABANDONED})

    @writing
    def _forget(self, session: Session, league: str, number: int) -> None:
        """Delete the row of an abandoned version whose files are removed."""
        session.execute(delete(VersionTable).filter_by(league=league, number=number, state=ABANDONED))

    @writing
    def _stale(self, session: Session, league: str) -> list[int]:
        """Abandon reservations whose publisher is dead; returns the numbers of all abandoned versions."""
        unfinished = session.scalars(select(VersionTable).filter_by(league=league).where(VersionTable.state != READY))
        numbers = []
        for version in unfinished:
            if version.state == PUBLISHING and not is_dead(version.publisher, version.reserved_at):
                continue
            version.state = ABANDONED
            numbers.append(version.number)
        return numbers


def _check_base(version: VersionRow, interface_digest: str) -> None:
    if version.retired_at is not None:
        raise VersionRetired(f"{version.ref} was retired and its files were removed: it cannot play")
    version.require_policies()
    if version.manifest.interface.digest() != interface_digest:
        raise EnvironmentMismatch(f"{version.ref} has other spaces or policies than league {version.league} has now")


def reserve(session: Session, league: str, source: str, parent: int | None, above: int) -> int:
    """Reserve the next version number, higher than `above`.

    Raises UnknownLeague, LeagueArchived, or UnknownVersion of the parent.
    """
    row = leagues.lock_active(session, league)
    if parent is not None:
        versions.require(session, league, parent)
    row.last_version = max(row.last_version, above) + 1
    session.add(
        VersionTable(
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
    """Raise EnvironmentMismatch if a manifest does not describe the reserved version."""
    identity = (manifest.league, manifest.version, manifest.parent)
    if identity != (league, number, parent):
        raise EnvironmentMismatch(
            f"the manifest is of {manifest.league}@{manifest.version} with parent {manifest.parent}, "
            f"expected {league}@{number} with parent {parent}"
        )


def finish(session: Session, manifest: Manifest, text: str, source: str) -> int:
    """Make a version ready; `text` is its manifest.json.

    Returns the number of the ready version: another one if a concurrent publication of the same source was faster.
    Raises InterfaceChanged if its league has another interface.
    """
    row = leagues.lock(session, manifest.league)
    if row.interface_digest != manifest.interface.digest():
        raise InterfaceChanged(f"version {manifest.version} has other spaces or policies than league {manifest.league}")
    if (faster := versions.find_by_source(session, manifest.league, source)) is not None:
        return faster
    values = {
        "state": READY,
        "role": manifest.role,
        "exploits": manifest.exploits,
        "manifest": text,
        "sha256": hashlib.sha256(text.encode()).hexdigest(),
    }
    if not _leave_publishing(session, manifest.league, manifest.version, values):
        raise StorageError(f"publishing {manifest.league}@{manifest.version} took too long: its files were removed")
    return manifest.version


def is_dead(publisher: str, reserved_at: datetime) -> bool:
    """Return whether `publisher` will not finish the publication that it began at `reserved_at`.

    If this is wrong, that process loses its publication and nothing else: the version can no longer become ready.
    """
    return datetime.now(UTC) - reserved_at > PUBLICATION_TIMEOUT or has_ended(publisher)


def _leave_publishing(session: Session, league: str, number: int, values: dict[str, str | None]) -> bool:
    statement = update(VersionTable).filter_by(league=league, number=number, state=PUBLISHING).values(**values)
    return row_count(session, statement) == 1
