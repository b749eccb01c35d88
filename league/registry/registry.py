"""The registry: one repository per aggregate on a shared database and artefact store."""

from contextlib import AbstractContextManager
from pathlib import Path
from typing import Self

from league.registry.aliases import AliasRepository
from league.registry.changes import ChangeRepository
from league.registry.deletion.removal import RemovalRepository
from league.registry.deletion.retention import RetentionRepository
from league.registry.evaluations import EvaluationRepository
from league.registry.gateways import GatewayRepository
from league.registry.keys import KeyRepository
from league.registry.leagues import LeagueRepository
from league.registry.publishing import VersionPublisher
from league.registry.replicas import ReplicaRepository
from league.registry.snapshots import SnapshotRepository
from league.registry.storage import exclusive_lock
from league.registry.storage.artifacts import ArtifactStore
from league.registry.storage.database import Database
from league.registry.storage.object_artifacts import ObjectArtifactStore
from league.registry.traffic import TrafficRepository
from league.registry.training.nights import TrainingNightRepository
from league.registry.training.runs import RunRepository
from league.registry.training.strength import StrengthRepository
from league.registry.verdicts import NightlyRunRepository, VerdictRepository
from league.registry.versions import VersionRepository
from league.settings import Storage

OBJECT_STORE_FILES = "object-store"
"""Directory in the home: cached files of an object store, and uploads in progress."""


class Registry:
    """Leagues, versions, aliases, verdicts, evaluations and training runs. Thread-safe.

    Each method of a repository is one transaction, except `publisher.publish`. All raise StorageError if the database
    or the artefact store fails.
    """

    def __init__(self, storage: Storage, database: Database) -> None:
        self.storage, self.database = storage, database
        self.artifacts = (
            ArtifactStore(storage.artifacts)
            if isinstance(storage.artifacts, Path)
            else ObjectArtifactStore(storage.artifacts, storage.home / OBJECT_STORE_FILES)
        )
        self.leagues = LeagueRepository(database)
        self.versions = VersionRepository(database, self.artifacts)
        self.retention = RetentionRepository(database, self.artifacts)
        self.removal = RemovalRepository(database, self.artifacts, storage.home)
        self.publisher = VersionPublisher(database, self.artifacts)
        self.aliases = AliasRepository(database)
        self.traffic = TrafficRepository(database)
        self.replicas = ReplicaRepository(database)
        self.changes = ChangeRepository(database)
        self.keys = KeyRepository(database)
        self.verdicts = VerdictRepository(database)
        self.nightly_runs = NightlyRunRepository(database)
        self.training_nights = TrainingNightRepository(database)
        self.evaluations = EvaluationRepository(database)
        self.gateways = GatewayRepository(database)
        self.runs = RunRepository(database)
        self.strength = StrengthRepository(database)
        self.snapshots = SnapshotRepository(database)

    @classmethod
    def open(cls, storage: Storage | None = None, create: bool = True, listens: bool = False) -> Self:
        """Open the registry at `storage`, by default from the environment, and migrate its schema if necessary.

        create: create an SQLite database that does not exist. listens: for one thread, with one connection that
        PostgreSQL notifies of changes which replicas follow.
        """
        storage = storage or Storage.from_environment()
        return cls(storage, Database(storage.database_url, create, listens))

    def close(self) -> None:
        """Close the database connections."""
        self.database.close()

    def needs_evaluation_service(self) -> bool:
        """Return whether an evaluation is queued or running, or snapshots are outdated."""
        return bool(self.evaluations.counts() or self.snapshots.stale())

    def exclusive_lock(self, name: str) -> AbstractContextManager[None]:
        """Hold a lock across all machines that share the database. Raises AlreadyRunning or StorageError.

        The lock is released when the process ends for any reason. If it is lost earlier, because the connection to
        PostgreSQL ends, further changes by this thread raise StorageError.
        """
        return exclusive_lock.hold(self.database, self.storage.home, name)
