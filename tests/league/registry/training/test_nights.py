"""Nights of training of several leagues."""

from league.registry.registry import Registry
from tests.support.leagues.registries import LEAGUE, registered


def test_nights_are_numbered_within_their_league(registry: Registry) -> None:
    registered(registry, "chess")
    for league in (LEAGUE, "chess", LEAGUE):
        opened = registry.training_nights.open(league)
        assert registry.training_nights.open(league) == opened, "the night that is open"
        closed = registry.training_nights.close(opened.id)
        assert closed.number == opened.number
    nights = registry.training_nights.all(LEAGUE)
    assert [night.number for night in nights] == [1, 2]
    assert [night.id for night in nights] == [1, 3]
    assert closed == nights[-1]
    assert [night.number for night in registry.training_nights.all("chess")] == [1]
