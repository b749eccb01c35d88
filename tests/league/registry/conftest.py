from collections.abc import Iterator

import pytest

from league.registry.registry import Registry
from league.settings import Storage
from tests.support.leagues.registries import registered


@pytest.fixture
def empty(storage: Storage) -> Iterator[Registry]:
    """A registry without a league."""
    registry = Registry.open(storage)
    yield registry
    registry.close()


@pytest.fixture
def registry(empty: Registry) -> Registry:
    """A registry with one league and no versions."""
    return registered(empty)
