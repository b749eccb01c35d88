"""Changes that replicas follow are counted, in the order of their commits."""

import time
from collections.abc import Callable

import pytest

from league.config.league import LeagueConfig
from league.errors import StorageError
from league.refs import CheckpointRef
from league.registry.aliases import ANY
from league.registry.registry import Registry
from league.registry.storage import change_counter
from league.registry.storage.database import before
from league.registry.storage.rows import ChangeCounts, Portion
from tests.support.databases import on_both_databases
from tests.support.leagues.registries import LEAGUE, config, interface, registered

pytestmark = on_both_databases


def promote(registry: Registry, version: int, league: str = LEAGUE) -> None:
    registry.aliases.set(league, "champion", version, expected=ANY, actor="test", reason="test")


def register(registry: Registry, play: dict[str, object]) -> None:
    """Register the league again with these settings of matches."""
    league = LeagueConfig.from_mapping(config().model_dump(by_alias=True) | {"play": play})
    registry.leagues.register(league, interface())


@pytest.fixture
def two_versions(registry: Registry) -> Registry:
    return registered(registry, LEAGUE, versions=2)


def test_what_replicas_follow_is_counted_and_nothing_else(two_versions: Registry) -> None:
    registry, options = two_versions, {"actor": "test", "reason": "test"}
    changes: list[tuple[Callable[[], object], tuple[int, ...]]] = [
        (lambda: promote(registry, 1), (1, 0, 0, 1)),
        (lambda: promote(registry, 1), (1, 0, 0, 1)),
        (lambda: promote(registry, 2), (2, 0, 0, 1)),
        (lambda: registry.aliases.rollback(LEAGUE, **options), (3, 0, 0, 1)),
        (lambda: registry.traffic.set(LEAGUE, canary=Portion(2, 0.5), **options), (3, 1, 0, 1)),
        (lambda: registry.traffic.set(LEAGUE, canary=Portion(2, 0.5), **options), (3, 1, 0, 1)),
        (lambda: registry.keys.create("bot", ["act"]), (3, 1, 1, 1)),
        (lambda: registry.keys.revoke("bot"), (3, 1, 2, 1)),
        (lambda: registry.keys.revoke("bot"), (3, 1, 2, 1)),
        (lambda: registered(registry, "another"), (3, 1, 2, 2)),
        (lambda: register(registry, {"opening_plies": 2}), (3, 1, 2, 2)),
        (lambda: register(registry, {"actions": "greedy"}), (3, 1, 2, 2)),
        (lambda: register(registry, {"actions": "sampled"}), (3, 1, 2, 3)),
        (lambda: register(registry, {}), (3, 1, 2, 4)),
        (lambda: registry.removal.remove_version(CheckpointRef(LEAGUE, 2), force=True), (4, 2, 2, 5)),
        (lambda: registry.removal.remove_league(LEAGUE, force=True), (5, 3, 2, 6)),
    ]
    with registry.database.write() as session:
        change_counter.count(session, "aliases")
        session.rollback()
    assert registry.changes.counts() == (0, 0, 0, 1)
    for change, expected in changes:
        change()
        assert registry.changes.counts() == expected


def test_changes_of_different_leagues_are_committed_one_after_the_other(two_versions: Registry) -> None:
    """A replica that has read the event of the later one has read the earlier one, too."""
    registered(two_versions, "another", versions=1)
    with two_versions.database.write() as session:
        change_counter.count(session, "aliases")
        with pytest.raises(StorageError), before(time.monotonic() + 0.2):
            promote(two_versions, 1, "another")
    promote(two_versions, 1, "another")
    assert two_versions.changes.counts() == ChangeCounts(2, 0, 0, 2)
