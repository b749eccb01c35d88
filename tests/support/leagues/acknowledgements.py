"""Acknowledgements of replicas, without replicas."""

from collections.abc import Mapping
from datetime import timedelta
from types import MappingProxyType

from sqlalchemy import update

from league.registry.registry import Registry
from league.registry.storage.database import clock
from league.registry.storage.rows import ReadPosition, ServedState
from league.registry.storage.tables import ReplicaTable


def acknowledge(
    registry: Registry,
    replica: str,
    league: str,
    version: int | None,
    sha256: str | None,
    fault: str | None = None,
    aliases: Mapping[str, int] = MappingProxyType({}),
    traffic: int | None = None,
    event: int | None = None,
) -> None:
    """Let a replica, registered if necessary, report what it serves of a league, which differs from what it read."""
    state = ServedState(version, sha256, fault, dict(aliases), event, traffic)
    position = ReadPosition(registry.changes.counts().to_acknowledge, event or 0, traffic or 0)
    if not registry.replicas.acknowledge(replica, position, {league: state}, ()):
        registry.replicas.register(replica, {})
        registry.replicas.acknowledge(replica, position, {league: state}, ())


def read_everything(registry: Registry, replica: str) -> None:
    """Let a replica, registered if necessary, report that it serves what the registry requires now."""
    events = [target.event for target in registry.aliases.all().values()]
    settings = [setting.id or 0 for setting in registry.traffic.all().values()]
    newest = max(events, default=0), max(settings, default=0)
    position = ReadPosition(registry.changes.counts().to_acknowledge, *newest)
    if not registry.replicas.acknowledge(replica, position, {}):
        registry.replicas.register(replica, {})
        registry.replicas.acknowledge(replica, position, {})


def silence(registry: Registry, replica: str, by: timedelta) -> None:
    """Let the last report of a replica be older."""
    with registry.database.write() as session:
        session.execute(update(ReplicaTable).filter_by(replica=replica).values(seen_at=clock(session) - by))
