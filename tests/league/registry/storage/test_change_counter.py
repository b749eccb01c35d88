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
from tests.support.leagues.registries import LEAGUE, config, interface, registered


def promote(registry: Registry, version: int, league: str = LEAGUE) -> None:
    registry.aliases.set(league, "champion", version, expected=ANY, actor="test", reason="test")


def register(registry: Registry, play: dict[str, object]) -> None:
    """Register the league again with these settings of matches."""
    league = LeagueConfig.from_mapping(config().model_dump(by_alias=True) | {"play": play})
    registry.leagues.register(league, interface())


@pytest.fixture
def two_versions(local: Registry) -> Registry:
    return registered(local, LEAGUE, versions=2)


CHANGES: list[tuple[Callable[[Registry], object], ChangeCounts]] = [
    (lambda registry: promote(registry, 1), ChangeCounts(1, 0, 0, 1)),
    (lambda registry: promote(registry, 1), ChangeCounts(1, 0, 0, 1)),
    (lambda registry: promote(registry, 2), ChangeCounts(2, 0, 0, 1)),
    (lambda registry: registry.aliases.rollback(LEAGUE, actor="test", reason="test"), ChangeCounts(3, 0, 0, 1)),
    (
        lambda registry: registry.traffic.set(LEAGUE, canary=Portion(2, 0.5), actor="test", reason="test"),
        ChangeCounts(3, 1, 0, 1),
    ),
    (
        lambda registry: registry.traffic.set(LEAGUE, canary=Portion(2, 0.5), actor="test", reason="test"),
        ChangeCounts(3, 1, 0, 1),
    ),
    (lambda registry: registry.keys.create("bot", ["act"]), ChangeCounts(3, 1, 1, 1)),
    (lambda registry: registry.keys.revoke("bot"), ChangeCounts(3, 1, 2, 1)),
    (lambda registry: registry.keys.revoke("bot"), ChangeCounts(3, 1, 2, 1)),
    (lambda registry: registered(registry, "another"), ChangeCounts(3, 1, 2, 2)),
    (lambda registry: register(registry, {"opening_plies": 2}), ChangeCounts(3, 1, 2, 2)),
    (lambda registry: register(registry, {"actions": "greedy"}), ChangeCounts(3, 1, 2, 2)),
    (lambda registry: register(registry, {"actions": "sampled"}), ChangeCounts(3, 1, 2, 3)),
    (lambda registry: register(registry, {}), ChangeCounts(3, 1, 2, 4)),
    (
        lambda registry: registry.removal.remove_version(CheckpointRef(LEAGUE, 2), force=True),
        ChangeCounts(4, 2, 2, 5),
    ),
    (lambda registry: registry.removal.remove_league(LEAGUE, force=True), ChangeCounts(5, 3, 2, 6)),
]


def test_what_replicas_follow_is_counted_and_nothing_else(two_versions: Registry) -> None:
    assert two_versions.changes.counts() == ChangeCounts(0, 0, 0, 1)
    for change, expected in CHANGES:
        change(two_versions)
        assert two_versions.changes.counts() == expected


def test_a_change_that_fails_is_not_counted(two_versions: Registry) -> None:
    with two_versions.database.write() as session:
        change_counter.count(session, "aliases")
        session.rollback()
    assert two_versions.changes.counts() == ChangeCounts(0, 0, 0, 1)


def test_changes_of_different_leagues_are_committed_one_after_the_other(two_versions: Registry) -> None:
    """A replica that has read the event of the later one has read the earlier one, too."""
    registered(two_versions, "another", versions=1)
    with two_versions.database.write() as session:
        change_counter.count(session, "aliases")
        with pytest.raises(StorageError), before(time.monotonic() + 0.2):
            promote(two_versions, 1, "another")
    promote(two_versions, 1, "another")
    assert two_versions.changes.counts() == ChangeCounts(2, 0, 0, 2)
