"""Gateways are found while they are announced."""

from dataclasses import replace
from datetime import timedelta

import pytest

from league.errors import UnknownLeague
from league.registry import gateways
from league.registry.gateways import Gateway
from league.registry.registry import Registry
from tests.support.leagues.registries import LEAGUE

TRAINING = Gateway("http://127.0.0.1:4001", "a", LEAGUE, "training", simulators=2)


EVALUATION = Gateway("http://127.0.0.1:4002", "b", LEAGUE, "evaluation", simulators=2, waiting=7)


def test_gateways_are_found_until_they_close(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    for gateway in (TRAINING, EVALUATION):
        registry.gateways.announce(gateway)
    assert registry.gateways.open(LEAGUE) == [EVALUATION, TRAINING], "an evaluation comes first"
    lonely = replace(TRAINING, simulators=0)
    registry.gateways.announce(lonely)
    assert registry.gateways.open(LEAGUE) == [lonely, EVALUATION], "those with fewer simulators come first"
    assert registry.gateways.open("another") == []
    registry.gateways.close(EVALUATION)
    assert registry.gateways.open(LEAGUE) == [lonely]
    with pytest.raises(UnknownLeague):
        registry.gateways.announce(replace(TRAINING, league="another"))
    monkeypatch.setattr(gateways, "SILENCE", timedelta(0))
    assert registry.gateways.open(LEAGUE) == [], "its process has died"
