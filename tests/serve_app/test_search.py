"""Search versions are served like others, by the search service, whose calls share messages."""

import asyncio
from collections.abc import Awaitable, Iterator
from pathlib import Path
from time import monotonic
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

from league.errors import GraphTimeout
from league.policies.policy import Policy
from league.registry.aliases import ANY
from league.registry.registry import Registry
from league.registry.storage.rows import Portion
from league.search.policies import contestant, publish_search
from league.settings import Storage
from league.spaces import ACTION_MASK, OBSERVATION, Discrete
from policy_league_client import Client
from policy_league_client.requests import ActionRequest, BatchActionRequest
from policy_league_client.responses import parse_action_response, parse_batch_action_response
from serve_app.live_versions.remote_search import LATENCIES, MESSAGES, CallQueue, RemoteSearch, SearchClient
from tests.support.clients.triton import Triton
from tests.support.leagues import tictactoe
from tests.support.leagues.tictactoe import LEAGUE
from tests.support.policies.graphs import masked_mlp
from tests.support.servers.exposition import value
from tests.support.servers.local_search import LocalHandle, searching_replica, searching_server
from tests.support.servers.protocol_servers import Listening
from tests.support.servers.replicas import local_client, replica
from tests.support.templates import copy_of
from tests.support.waiting import until

GAMES = [(), (0, 4), (0, 1, 3, 4), (4, 0, 8, 2)]
SEARCH = 2
SLOW = 3


@pytest.fixture
def registry(tmp_path: Path) -> Registry:
    return copy_of(build_searching, Storage.at(tmp_path / "home"))


def build_searching(storage: Storage) -> Registry:
    """Version 2 searches with version 1, the champion; version 3 does so for a long time."""
    opened = tictactoe.registry(storage.home, gate={"max_blocks": 4})
    tictactoe.publish(opened, masked_mlp((3, 3, 2), 9), value=masked_mlp((3, 3, 2), 9, has_value=True))
    league, base = opened.leagues.get(LEAGUE), opened.versions.get(LEAGUE, 1)
    for simulations in (50, 10_000):
        publish_search(opened, base, league.config.environment, league.interface, "puct", simulations)
    promote(opened, 1)
    return opened


@pytest.fixture
def served(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[TestClient, LocalHandle]]:
    with searching_replica(registry, monkeypatch) as served:
        yield served


def promote(registry: Registry, number: int) -> None:
    registry.aliases.set(LEAGUE, "champion", number, expected=ANY, actor="test", reason="test")


def position(actions: tuple[int, ...]) -> dict[str, list]:
    """The board after some moves, as the next player sees it."""
    planes = np.zeros((9, 2), dtype=np.int8)
    for ply, action in enumerate(actions):
        planes[action, (len(actions) - ply) % 2] = 1
    mask = (planes.sum(axis=1) == 0).astype(np.int8)
    return {OBSERVATION: planes.reshape(3, 3, 2).tolist(), ACTION_MASK: mask.tolist()}


def searched(registry: Registry) -> Policy:
    league = registry.leagues.get(LEAGUE)
    players = contestant(f"{LEAGUE}@{SEARCH}", registry, league.interface, league.config.environment)
    return next(policy for _, policy in players.values())


BOARDS = [position(actions) for actions in GAMES]
PATH = f"/v1/policies/{LEAGUE}/action"


REQUEST = {"observation": BOARDS[0]}


def test_all_protocols_return_the_actions_of_the_search(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    arrays = {name: np.array([board[name] for board in BOARDS], dtype=np.int8) for name in BOARDS[0]}
    expected = searched(registry).act(arrays)
    server, _ = searching_server(registry, monkeypatch)
    with local_client(server) as client:
        body = {"observations": BOARDS, "probabilities": True}
        batch = client.post(f"{PATH}?version={SEARCH}", json=body).json()
        assert batch["actions"] == expected.actions.tolist()
        assert (batch["version"], batch["simulations"]) == (SEARCH, [50] * len(BOARDS))
        assert np.allclose(batch["probabilities"], np.exp(expected.dist_inputs))
        alone = client.post(f"{PATH}?version={SEARCH}", json={"observation": BOARDS[1]}).json()
        assert (alone["action"], alone["simulations"]) == (batch["actions"][1], 50)
        with client.websocket_connect(f"/v1/policies/{LEAGUE}/stream?version={SEARCH}") as stream:
            stream.send_json({"observations": BOARDS})
            assert stream.receive_json()["actions"] == batch["actions"]
    server, _ = searching_server(registry, monkeypatch)
    with Listening(server) as address:
        for form in ("http", "grpc"):
            with Triton(form, address) as triton:
                outputs = ("action", "action_dist_inputs")
                result = triton.infer(LEAGUE, arrays, version=str(SEARCH), outputs=outputs)
            assert result.as_numpy("action").tolist() == expected.actions.tolist()
            assert np.allclose(result.as_numpy("action_dist_inputs"), expected.dist_inputs)


def test_the_leaderboard_shows_searches(registry: Registry, served: tuple[TestClient, LocalHandle]) -> None:
    standing = {"rating": None, "interval": None, "score": 0.5, "mean_return": None, "games": 2, "unique_games": None}
    rows = [standing | {"ref": ref} for ref in (f"{LEAGUE}@{SEARCH}", f"{LEAGUE}@1", "script:random")]
    document = {"sides": [], "leaderboard": rows, "by_side": {}, "not_champion": None}
    registry.snapshots.put(LEAGUE, {"leaderboard": document}, registry.snapshots.current_marks()[LEAGUE])
    client, _ = served
    searching, *scripts = client.get(f"/v1/leagues/{LEAGUE}/leaderboard").json()["leaderboard"]
    search = searching["search"]
    assert (search["version"], search["rule"], search["simulations"], search["ms"] > 0) == (1, "puct", 50, True)
    assert [row["search"] for row in scripts] == [None, None]


def test_a_search_version_is_a_canary_a_shadow_and_a_champion(
    registry: Registry, served: tuple[TestClient, LocalHandle]
) -> None:
    client, _ = served

    def versions() -> set[int]:
        replies = [client.post(PATH, json=REQUEST, headers={"x-league-key": str(caller)}) for caller in range(16)]
        return {reply.json()["version"] for reply in replies}

    registry.traffic.set(LEAGUE, canary=Portion(SEARCH, 0.5), actor="test", reason="test")
    until(lambda: versions() == {1, SEARCH})
    shadow = Portion(SEARCH, 1.0)
    registry.traffic.set(LEAGUE, canary=None, shadow=shadow, actor="test", reason="test")
    until(lambda: versions() == {1} and value(client, "league_shadow_requests_total", league=LEAGUE) > 0)
    promote(registry, SEARCH)
    until(lambda: versions() == {SEARCH})
    registry.aliases.rollback(LEAGUE, actor="test", reason="test")
    until(lambda: versions() == {1})


def test_a_deadline_ends_a_search_and_an_analysis_explains_it(served: tuple[TestClient, LocalHandle]) -> None:
    client, _ = served
    path = f"{PATH}?version={SLOW}"
    request = ActionRequest.build(BOARDS[1], "lists", deadline_ms=20, analysis=True)
    reply = parse_action_response(client.post(path, json=request.body).json(), "replica-1", None)
    assert reply.simulations is not None
    assert reply.analysis is not None
    assert 0 < reply.simulations < 10_000
    assert sum(reply.analysis.visits) == reply.simulations
    assert reply.analysis.line[0] == reply.action == np.argmax(reply.analysis.visits)
    assert -1 <= reply.analysis.value <= 1
    assert len(set(reply.analysis.line) - {0, 4}) == len(reply.analysis.line)
    batch = BatchActionRequest.build(BOARDS, "lists", deadline_ms=1, analysis=True)
    replies = parse_batch_action_response(client.post(path, json=batch.body).json(), "replica-1", None)
    row = replies.response(3)
    assert row.analysis is not None
    assert row.simulations == sum(row.analysis.visits)


def test_the_client_requests_a_deadline_and_an_analysis(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    server, _ = searching_server(registry, monkeypatch)
    options = {"deadline_ms": 20, "analysis": True}
    with (
        Listening(server) as address,
        Client(f"http://{address.http}", timeout=60) as client,
        client.episode(f"{LEAGUE}@{SLOW}") as episode,
    ):
        response = client.act(f"{LEAGUE}@{SLOW}", BOARDS[1], **options)
        episode.act(BOARDS[1], **options)
    for reply in (response, episode.last):
        assert reply is not None
        assert reply.analysis is not None
        assert sum(reply.analysis.visits) == reply.simulations
        assert reply.analysis.line[0] == reply.action
        assert reply.simulations < 10_000


def test_what_cannot_be_searched_is_refused(registry: Registry, served: tuple[TestClient, LocalHandle]) -> None:
    client, _ = served
    impossible = position((0, 1, 2)) | {OBSERVATION: [[[1, 1]] * 3] * 3}
    for body, version, message in (
        ({"deadline_ms": 0}, SEARCH, "deadline_ms must be null or an integer from 1 to 86400000"),
        ({"analysis": True}, 1, "analysis is true, but this version does not search"),
        ({"observation": impossible}, SEARCH, "not a position"),
    ):
        reply = client.post(f"{PATH}?version={version}", json=REQUEST | body)
        assert (reply.status_code, message in reply.json()["message"]) == (400, True)
    with replica(registry.storage) as without_service:
        reply = without_service.post(f"{PATH}?version={SEARCH}", json=REQUEST)
        assert (reply.status_code, reply.json()["code"]) == (503, "no_search_service")
        assert without_service.post(PATH, json=REQUEST).json()["version"] == 1


def test_a_call_whose_process_ends_is_repeated(served: tuple[TestClient, LocalHandle]) -> None:
    client, handle = served
    for deaths in (0, 3):
        handle.deaths = deaths
        assert client.post(f"{PATH}?version={SEARCH}", json=REQUEST).status_code == 200
        assert handle.deaths == 0
    until(lambda: handle.calls.count("stay") > 0)


class HeldService:
    """Stands for the handle: answers each message with its calls, once `released` is set."""

    def __init__(self) -> None:
        self.released = asyncio.Event()
        self.messages: list[list[tuple[object, ...]]] = []
        self.ended = 0

    @property
    def searches(self) -> "HeldService":
        return self

    def remote(self, calls: list[tuple[object, ...]]) -> Awaitable[list[dict[str, Any]]]:
        """A message."""
        self.messages.append(calls)
        return self._answer(calls)

    async def _answer(self, calls: list[tuple[object, ...]]) -> list[dict[str, Any]]:
        try:
            await self.released.wait()
        except asyncio.CancelledError:
            self.ended += 1
            raise
        return [{"call": call[0], "seconds": 0.0} for call in calls]


@pytest.mark.anyio
@pytest.mark.parametrize("processes", [1, 3])
async def test_calls_that_wait_are_divided_among_the_messages(processes: int) -> None:
    service = HeldService()
    client, queue = SearchClient(service, processes), CallQueue()  # type: ignore[arg-type]
    async with client.running():
        calls = [asyncio.wrap_future(client.search(queue, lambda i=i: (i,), 60.0)) for i in range(20)]  # type: ignore[misc]
        await until_sent(service, MESSAGES * processes)
        service.released.set()
        assert [response["call"] for response in await asyncio.gather(*calls)] == list(range(20))
    assert sorted(call[0] for calls in service.messages for call in calls) == list(range(20))
    assert MESSAGES * processes < len(service.messages) < 20


@pytest.mark.anyio
async def test_abandoned_calls_are_not_sent_and_their_message_ends() -> None:
    service = HeldService()
    client, queue = SearchClient(service, 1), CallQueue()  # type: ignore[arg-type]
    async with client.running():
        sent = [asyncio.wrap_future(client.search(queue, lambda: ("sent",), 60.0)) for _ in range(MESSAGES)]
        await until_sent(service, MESSAGES)
        with pytest.raises(GraphTimeout, match=r"did not respond within 0\.01 s"):
            await asyncio.wrap_future(client.search(queue, lambda: ("late",), 0.01))
        sent[0].cancel()
        while not service.ended:
            await asyncio.sleep(0)
        service.released.set()
        assert (await sent[1])["call"] == "sent"
        assert await asyncio.wrap_future(client.search(queue, lambda: ("next",), 60.0)) == {
            "call": "next",
            "seconds": 0.0,
        }
    assert [calls for calls in service.messages if ("late",) in calls] == []


@pytest.mark.anyio
async def test_searches_end_earlier_by_the_time_that_messages_take() -> None:
    granted: list[float] = []

    async def answer(calls: list[tuple[Any, ...]]) -> list[dict[str, Any]]:
        granted.extend(call[5] for call in calls)
        await asyncio.sleep(0.05)
        return [{"code": "graph_timeout", "message": "", "seconds": 0.01} for _ in calls]

    handle = SimpleNamespace(searches=SimpleNamespace(remote=answer))
    client = SearchClient(handle, 1)  # type: ignore[arg-type]
    version = SimpleNamespace(league=LEAGUE, number=SEARCH, sha256="")
    policy = RemoteSearch(client, version, "shared", Discrete(n=9), 60.0)  # type: ignore[arg-type]
    async with client.running():
        for _ in range(LATENCIES + 1):
            with pytest.raises(GraphTimeout):
                await asyncio.to_thread(policy.bounded(monotonic() + 30).act, {"observation": np.zeros((1, 2))})
    assert granted[0] > granted[-1]
    assert granted[-1] <= 30 - 0.04


async def until_sent(service: HeldService, number: int) -> None:
    while len(service.messages) < number:
        await asyncio.sleep(0)
