"""Turns of stock, vectorised and external environments are those that were recorded: see `tests.support.turns`."""

from typing import Any

import pytest

from league.environments.implementation import stepping, stock_stepping
from tests.support.closeness import close
from tests.support.recordings import read
from tests.support.turns import FAULTS, INTERRUPTED, STOCK, TURNS, external, turns


def assert_recorded(name: str, documents: list[Any]) -> None:
    recorded = read("turns")[name]
    for number, (document, expected) in enumerate(zip(documents, recorded, strict=False)):
        assert close(document, expected, 2e-6), f"turn {number}: {document}, expected {expected}"
    assert len(documents) == len(recorded)


@pytest.mark.parametrize("name", [*TURNS, *STOCK, *FAULTS])
def test_turns_of_stock_environments_are_the_recorded_ones(name: str) -> None:
    assert_recorded(name, turns(name, stock_stepping))


@pytest.mark.parametrize("name", TURNS)
def test_turns_of_vectorised_environments_are_the_recorded_ones(name: str) -> None:
    assert_recorded(f"{name}, vectorised" if name == INTERRUPTED else name, turns(name, stepping))


def test_turns_with_fast_seeds_are_the_recorded_ones() -> None:
    assert_recorded("fast seeds", turns("Leduc hold'em", stepping, fast_seeds=True))


def test_episodes_of_simulators_are_the_recorded_ones() -> None:
    for name, episodes in external().items():
        assert close(episodes, read("turns")[name], 2e-6), name
