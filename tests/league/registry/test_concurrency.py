"""Several processes on one registry."""

import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from itertools import chain

import pytest

from league.errors import AliasMoved
from league.registry.registry import Registry
from league.settings import Storage
from tests.support.databases import on_both_databases
from tests.support.leagues.registries import LEAGUE, leftovers, publish, registered, verified

pytestmark = on_both_databases


PROCESSES = 2


@pytest.fixture(scope="module")
def processes() -> Iterator[ProcessPoolExecutor]:
    with ProcessPoolExecutor(PROCESSES, mp_context=multiprocessing.get_context("spawn")) as pool:
        yield pool


def _open(storage: Storage) -> int:
    registry = Registry.open(storage)
    registered(registry)
    registry.close()
    return len(registry.leagues.names())


def _publish(storage: Storage, sources: list[str]) -> list[int]:
    registry = Registry.open(storage)
    numbers = [publish(registry, source).number for source in sources]
    registry.close()
    return numbers


def _promote(storage: Storage, actor: str, rounds: int) -> int:
    """Attempt `rounds` compare-and-sets; returns how many succeeded."""
    registry, won = Registry.open(storage), 0
    for turn in range(rounds):
        expected = registry.aliases.current(LEAGUE).get("champion")
        version = 1 + (expected or 0) % 3
        try:
            event = registry.aliases.set(LEAGUE, "champion", version, expected=expected, actor=actor, reason=str(turn))
        except AliasMoved:
            continue
        assert (event.actor, event.reason, event.version) == (actor, str(turn), version)
        won += 1
    registry.close()
    return won


def test_processes_that_open_a_new_home_together_agree(processes: ProcessPoolExecutor, storage: Storage) -> None:
    assert list(processes.map(_open, [storage] * PROCESSES * 2)) == [1] * PROCESSES * 2


def test_each_compare_and_set_has_one_winner(
    processes: ProcessPoolExecutor, registry: Registry, storage: Storage
) -> None:
    registered(registry, versions=3)
    actors = [f"actor-{i}" for i in range(PROCESSES)]
    won = list(processes.map(_promote, [storage] * PROCESSES, actors, [15] * PROCESSES))
    history = registry.aliases.history(LEAGUE)[::-1]
    assert len(history) == sum(won)
    assert [sum(event.actor == actor for event in history) for actor in actors] == won
    assert [event.previous for event in history] == [None, *(event.version for event in history[:-1])]
    assert registry.aliases.current(LEAGUE) == {"champion": history[-1].version}


def test_publishers_share_no_number_and_publish_each_checkpoint_once(
    processes: ProcessPoolExecutor, registry: Registry, storage: Storage
) -> None:
    sources = [[f"run-{process}/{i}" for i in range(6)] for process in range(PROCESSES)]
    numbers = list(processes.map(_publish, [storage] * PROCESSES, sources))
    published = {version.number: version.source for version in registry.versions.all(LEAGUE)}
    assert published == dict(zip(chain(*numbers), chain(*sources), strict=True))
    assert sorted(published) == list(range(1, 6 * PROCESSES + 1))
    for number in published:
        verified(registry, number)
    same = [f"run/{i}" for i in range(6)]
    numbers = list(processes.map(_publish, [storage] * PROCESSES, [same] * PROCESSES))
    assert numbers == [numbers[0]] * PROCESSES
    assert [version.source for version in registry.versions.all(LEAGUE)][len(published) :] == same
    assert leftovers(registry) == []
