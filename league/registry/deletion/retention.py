"""Removes the files of versions that nothing needs any more.

The training state of a version is by far its largest part, and only needed to continue training from it. It is kept
for the versions that an alias points to, for the newest ones, and for young ones. All files of a version are removed if
moreover no alias ever pointed to it, no canary, shadow, verdict or recorded game refers to it, and its league is not
being trained, since any version may be an opponent. Its row stays: the version is *retired*, and its number is never
reused. What refers to a mixture refers to its members. The version that a search version plays with keeps its files.

Versions are marked before their files are removed. An interrupted removal is completed by the next one.
"""

import json
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from datetime import UTC, datetime

from sqlalchemy import select
from sqlalchemy.orm import Session

from league.registry import leagues, traffic, versions
from league.registry.storage import change_counter
from league.registry.storage.artifacts import ArtifactStore
from league.registry.storage.database import Database, Repository, reading
from league.registry.storage.manifest import MIXTURE, SEARCH
from league.registry.storage.rows import AliasEvent, NightlyRunRow, VerdictRow
from league.registry.storage.tables import READY, AliasTable, ScheduleTable, VersionTable
from league.registry.training import runs
from league.registry.verdicts import VOID


@dataclass(frozen=True, slots=True)
class Removal:
    """What is removed from a league, with the size of the files in bytes."""

    league: str
    versions: dict[int, int]
    """Version that is retired → size of its files."""
    training: dict[int, int]
    """Other version → size of its training state."""

    @property
    def size(self) -> int:
        """Size of all files, in bytes."""
        return sum(self.versions.values()) + sum(self.training.values())


class RetentionRepository(Repository):
    """Finds and removes the files of versions that nothing needs."""

    def __init__(self, database: Database, artifacts: ArtifactStore) -> None:
        super().__init__(database)
        self._artifacts = artifacts

    @reading
    def plan(self, session: Session, league: str, *, keep: int, before: datetime) -> Removal:
        """Return what `retire` would remove. Raises UnknownLeague."""
        leagues.require(session, league)
        return self._removal(league, *_candidates(session, league, keep, before))

    def retire(self, league: str, *, keep: int, before: datetime) -> Removal:
        """Retire versions and remove files. Returns what was removed.

        Args:
            league: The league.
            keep: Number of newest versions that are not touched.
            before: Only versions published before this time are touched.

        Raises:
            UnknownLeague: The league does not exist.
            StorageError: A file cannot be removed. The next call removes it.
        """
        with self._database.write() as session:
            leagues.lock(session, league)
            retired, untrained = _candidates(session, league, keep, before)
            rows = [session.get_one(VersionTable, (league, number)) for number in sorted(retired)]
            if new := [row for row in rows if row.retired_at is None]:
                change_counter.count(session, "leagues")
            for row in new:
                row.retired_at = datetime.now(UTC)
        removal = self._removal(league, retired, untrained)
        for number in removal.versions:
            self._artifacts.discard(league, number)
        for number in removal.training:
            self._artifacts.remove_training(league, number)
        return removal

    def _removal(self, league: str, retired: AbstractSet[int], untrained: AbstractSet[int]) -> Removal:
        sizes = {number: self._artifacts.size(league, number) for number in sorted(retired)}
        training = {number: self._artifacts.training_size(league, number) for number in sorted(untrained)}
        return Removal(
            league,
            {number: size for number, size in sizes.items() if size},
            {number: size for number, size in training.items() if size},
        )


def _candidates(session: Session, league: str, keep: int, before: datetime) -> tuple[set[int], set[int]]:
    """Return the versions to retire, including those already retired, and those that lose their training state."""
    table = VersionTable
    ready = session.scalars(
        select(table).filter_by(league=league, state=READY, retired_at=None).order_by(table.number.desc())
    ).all()
    old = {version.number for version in ready[keep:] if version.reserved_at < before}
    aliased = set(session.scalars(select(AliasTable.version).filter_by(league=league)))
    old -= aliased | versions.members(session, league, aliased)
    # Mixtures and search versions have no files but their manifests.
    searching = set(session.scalars(select(table.number).filter_by(league=league, role=SEARCH)))
    needed = _needed(session, league) | searching
    needed |= versions.members(session, league, needed)
    if runs.is_trained(session, league):
        needed |= old  # any version may be an opponent
    needed |= set(session.scalars(select(table.number).filter_by(league=league, role=MIXTURE)))
    gone = session.scalars(select(table.number).where(table.league == league, table.retired_at.is_not(None)))
    return (old - needed) | set(gone), old & needed


def _needed(session: Session, league: str) -> set[int]:
    """Return the versions that an alias pointed to, or that traffic, a verdict or a recorded game refers to."""
    needed = set(session.scalars(select(AliasEvent.version).filter_by(league=league)))
    setting = traffic.current_setting(session, league)
    needed |= {
        portion.version for portion in (setting.canary, setting.shadow) if portion and isinstance(portion.version, int)
    }
    verdicts = select(VerdictRow).where(VerdictRow.league == league, VerdictRow.outcome.is_distinct_from(VOID))
    refs: set[str] = set()
    for verdict in session.scalars(verdicts):
        needed.add(verdict.candidate)
        refs.add(verdict.champion)
    for candidates in session.scalars(select(NightlyRunRow.candidates).filter_by(league=league, ended_at=None)):
        needed |= set(candidates)
    counted = select(ScheduleTable).filter_by(league=league, purged_at=None)
    for schedule in session.scalars(counted):
        refs |= set(json.loads(schedule.document)["contestants"])
    fixed = (ref.partition("@") for ref in refs)
    return needed | {int(number) for name, _, number in fixed if name == league and number.isdecimal()}
