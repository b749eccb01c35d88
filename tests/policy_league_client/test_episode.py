"""Episodes over HTTP stay on the version that started them, or report that it is gone."""

import shutil

import numpy as np
import pytest

from league.errors import InvalidReference, UnknownLeague, UnknownVersion, VersionRetired
from league.registry.registry import Registry
from serve_app.runtime.haproxy import free_ports
from tests.support.clients.actions import BOARD
from tests.support.clients.sync_and_async import Connect
from tests.support.leagues.served_leagues import promote
from tests.support.servers.streaming import Listening, listening
from tests.support.waiting import until

ONE = np.ones(1, np.float32)


def test_an_episode_keeps_its_version_across_promotions(
    connect: Connect, registry: Registry, listener: Listening
) -> None:
    client = connect(listener.url)
    registry.aliases.set("board", "candidate", 3, expected=None, actor="test", reason="test")
    with client.episode("board") as episode, client.episode("board@candidate") as of_alias:
        assert (episode.version, episode.last, episode.steps) == (None, None, 0)
        first = episode.act(BOARD)
        of_alias.act(BOARD)
        promote(registry, "board", 2)
        registry.aliases.set("board", "candidate", 1, expected=3, actor="test", reason="test")
        until(lambda: client.act("board", BOARD).version == 2)
        assert [episode.act(BOARD) for _ in range(3)] == [first] * 3
        of_alias.act(BOARD)
        assert (episode.version, episode.steps, of_alias.version) == (1, 4, 3)
        assert episode.last is not None
        assert episode.last.version == 1
    with client.episode("board") as episode:
        episode.act(BOARD)
        assert episode.version == 2


def test_an_episode_carries_its_recurrent_state(connect: Connect, url: str) -> None:
    client = connect(url)
    with client.episode("memory") as one, client.episode("memory") as other:
        assert [one.act(ONE) for _ in range(4)] == [0, 0, 1, 1]
        assert [other.act(ONE) for _ in range(3)] == [0, 0, 1]


def test_an_exploring_episode_is_reproducible(connect: Connect, url: str) -> None:
    def play(seed: int | None) -> list[int]:
        with connect(url).episode("board", explore=True, seed=seed) as episode:
            return [episode.act(BOARD) for _ in range(30)]

    assert play(1) == play(1) != play(2)
    assert len(set(play(1))) > 1
    assert play(None) != play(None)
    with connect(url).episode("board", explore=True, seed=1) as episode:
        action = episode.act(BOARD, probabilities=True)
        assert episode.last is not None
        assert episode.last.probabilities[action] > 0
        alone = connect(url).act("board@1", BOARD, explore=True, seed=episode.last.seed)
        assert alone.action == action


def test_an_episode_survives_its_replica_but_not_its_version(connect: Connect, registry: Registry) -> None:
    (port,) = free_ports(1, "127.0.0.1")
    with listening(registry.storage, port=port) as first:
        client = connect(first.url)
        episode, other = client.episode("memory"), client.episode("board@3")
        assert [episode.act(ONE) for _ in range(2)] == [0, 0]
        other.act(BOARD)
    shutil.rmtree(registry.artifacts.path("board", 3))
    with listening(registry.storage, replica="replica-2", port=port):
        assert episode.act(ONE) == 1
        assert episode.last is not None
        assert episode.last.replica == "replica-2"
        with pytest.raises(VersionRetired, match=r"cannot continue after 1 actions of board@3"):
            other.act(BOARD)


@pytest.mark.parametrize(
    ("model", "expected"), [("nobody", UnknownLeague), ("board@99", UnknownVersion), ("a.b.c", InvalidReference)]
)
def test_an_episode_that_cannot_start_raises(connect: Connect, url: str, model: str, expected: type[Exception]) -> None:
    with pytest.raises(expected) as raised:
        connect(url).episode(model).act(BOARD)
    assert type(raised.value) is expected
