"""In a league with sampled actions, requests and shadows sample by default."""

from collections.abc import Iterator
from typing import Any

import pytest
from starlette.testclient import TestClient

from league.registry.registry import Registry
from tests.support.clients.actions import BOARD as OBSERVATION
from tests.support.clients.actions import act, boards
from tests.support.leagues.served_leagues import BOARD, promote, publish, register
from tests.support.policies.graphs import masked_mlp
from tests.support.servers.replicas import replica
from tests.support.servers.shadows import set_shadow, wait_for
from tests.support.waiting import until


def actions(client: TestClient, **body: Any) -> list[int]:
    """The actions of 32 requests with different seeds."""
    return [
        action
        for first in range(0, 32, 8)
        for action in act(client, observations=[OBSERVATION] * 8, seed=list(range(first, first + 8)), **body)["actions"]
    ]


@pytest.fixture
def sampled(registry: Registry) -> Iterator[TestClient]:
    """A replica of a registry in which version 4 of `board` has the graph of version 1, and version 5 is of DQN."""
    register(registry, "board", {"shared": BOARD}, actions="sampled")
    publish(registry, "board", {"shared": masked_mlp(seed=0)}, "run/copy")
    publish(registry, "board", {"shared": masked_mlp(seed=0)}, "run/dqn", algorithm="dqn")
    with replica(registry.storage) as client:
        yield client


def test_requests_sample_unless_they_refuse(sampled: TestClient) -> None:
    drawn = actions(sampled)
    assert len(set(drawn)) > 1
    assert drawn == actions(sampled, explore=True)
    assert len(set(actions(sampled, explore=False))) == 1
    assert sampled.get("/v1/leagues/board").json()["actions"] == "sampled"


def test_versions_without_a_distribution_stay_greedy(sampled: TestClient) -> None:
    greedy = act(sampled, version=1, observation=OBSERVATION, explore=False)["action"]
    assert set(actions(sampled, version=5)) == set(actions(sampled, version=5, explore=True)) == {greedy}
    for explore in (None, True, False):
        given = {} if explore is None else {"explore": explore}
        found = act(sampled, version=5, observation=OBSERVATION, probabilities=True, **given)
        assert found["probabilities"] == [float(action == greedy) for action in range(7)]


@pytest.mark.parametrize(("candidate", "is_equal"), [(4, True), (2, False)])
def test_a_shadow_samples_with_the_random_numbers_of_the_champion(
    sampled: TestClient, registry: Registry, candidate: int, is_equal: bool
) -> None:
    set_shadow(registry, candidate)
    observations = boards(40)
    for start in range(0, 40, 8):
        act(sampled, observations=observations[start : start + 8], **({"explore": False} if start == 8 else {}))
    found = wait_for(registry, lambda one: one.requests == 5, candidate=candidate)
    assert found.observations == 40
    assert (found.agreed == 40) == is_equal


def test_loaded_versions_follow_the_league(registry: Registry) -> None:
    """A candidate that is loaded after the change is compared with the champion by the same kind of actions."""
    publish(registry, "board", {"shared": masked_mlp(seed=0)}, "run/copy")
    with replica(registry.storage) as client:
        assert [len(set(actions(client, version=version))) for version in (1, 2)] == [1, 1]
        register(registry, "board", {"shared": BOARD}, actions="sampled")
        until(lambda: len(set(actions(client))) > 1)
        assert len(set(actions(client, version=2))) > 1
        set_shadow(registry, 4)
        act(client, observations=boards(8))
        found = wait_for(registry, lambda one: one.requests == 1, candidate=4)
        assert (found.observations, found.agreed) == (8, 8)
        register(registry, "board", {"shared": BOARD}, actions="greedy")
        until(lambda: len(set(actions(client))) == 1)


def test_a_new_version_samples_too(sampled: TestClient, registry: Registry) -> None:
    promote(registry, "board", 2)
    assert len(set(actions(sampled, version=2))) > 1
