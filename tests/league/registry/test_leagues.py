import pytest

from league.errors import InterfaceChanged, UnknownLeague
from league.registry.registry import Registry
from tests.support.leagues.registries import LEAGUE, config, interface, publish, registered


def test_a_league_is_stored_as_registered(registry: Registry) -> None:
    row = registry.leagues.get(LEAGUE)
    assert row.config == config()
    assert row.interface == interface()
    assert row.interface_digest == interface().digest()
    assert row.environment_digest == config().environment.digest()


def test_leagues_are_listed_by_name(registry: Registry) -> None:
    registered(registry, "another")
    assert [row.slug for row in registry.leagues.all()] == ["another", LEAGUE]


def test_registering_again_updates_the_configuration_and_keeps_the_versions(registry: Registry) -> None:
    before = registry.leagues.get(LEAGUE)
    version = publish(registry, "run/1")
    registry.leagues.register(config(kwargs={"screen_height": 500}), interface())
    after = registry.leagues.get(LEAGUE)
    assert after.config.environment.kwargs == {"screen_height": 500}
    assert after.environment_digest != before.environment_digest
    assert after.registered_at == before.registered_at
    assert registry.versions.all(LEAGUE) == [version]
    assert publish(registry, "run/2").number == 2


def test_an_interface_can_change_only_without_versions(registry: Registry) -> None:
    registry.leagues.register(config(), interface(squares=4))
    registry.leagues.register(config(), interface())
    publish(registry, "run/1")
    with pytest.raises(InterfaceChanged, match=LEAGUE):
        registry.leagues.register(config(), interface(squares=4))
    assert registry.leagues.get(LEAGUE).interface == interface()


def test_an_unknown_league_is_reported_with_the_known_ones(empty: Registry) -> None:
    with pytest.raises(UnknownLeague, match="no league 'chess'; known: none yet"):
        empty.leagues.get("chess")
    registered(empty)
    with pytest.raises(UnknownLeague, match=f"no league 'chess'; known: {LEAGUE}"):
        empty.versions.all("chess")
