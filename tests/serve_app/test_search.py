"""Search versions are served like others, by the search service."""

import asyncio
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from httpx import Response
from starlette.testclient import TestClient

from league.policies.policy import Policy
from league.registry.aliases import ANY
from league.registry.registry import Registry
from league.registry.storage.rows import Portion
from league.search.policies import contestant, publish_search
from league.settings import Storage
from league.spaces import ACTION_MASK, OBSERVATION
from policy_league_client.requests import ActionRequest, BatchActionRequest
from policy_league_client.responses import parse_action_response, parse_batch_action_response
from serve_app.live_versions.remote_search import MESSAGES
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


def test_all_protocols_return_the_actions_of_the_search(
    registry: Registry, served: tuple[TestClient, LocalHandle]
) -> None:
    client, _ = served
    arrays = {name: np.array([board[name] for board in BOARDS], dtype=np.int8) for name in BOARDS[0]}
    expected = searched(registry).act(arrays)
    batch = client.post(f"{PATH}?version={SEARCH}", json={"observations": BOARDS, "probabilities": True}).json()
    assert batch["actions"] == expected.actions.tolist()
    assert (batch["version"], batch["simulations"]) == (SEARCH, [50] * len(BOARDS))
    assert np.allclose(batch["probabilities"], np.exp(expected.dist_inputs))
    alone = client.post(f"{PATH}?version={SEARCH}", json={"observation": BOARDS[1]}).json()
    assert (alone["action"], alone["simulations"]) == (batch["actions"][1], 50)
    inputs = [
        {"name": name, "datatype": "INT8", "shape": array.shape, "data": array.ravel().tolist()}
        for name, array in arrays.items()
    ]
    path = f"/v2/models/{LEAGUE}/versions/{SEARCH}/infer"
    outputs = {
        output["name"]: output["data"] for output in client.post(path, json={"inputs": inputs}).json()["outputs"]
    }
    assert outputs["action"] == batch["actions"]
    with client.websocket_connect(f"/v1/policies/{LEAGUE}/stream?version={SEARCH}") as stream:
        stream.send_json({"observations": BOARDS})
        assert stream.receive_json()["actions"] == batch["actions"]


def test_triton_clients_call_it_by_grpc(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    arrays = {name: np.array([board[name] for board in BOARDS], dtype=np.int8) for name in BOARDS[0]}
    server, _ = searching_server(registry, monkeypatch)
    with Listening(server) as address, Triton("grpc", address) as triton:
        result = triton.infer(LEAGUE, arrays, version=str(SEARCH), outputs=("action", "action_dist_inputs"))
    expected = searched(registry).act(arrays)
    assert result.as_numpy("action").tolist() == expected.actions.tolist()
    assert np.allclose(result.as_numpy("action_dist_inputs"), expected.dist_inputs)


def test_it_answers_a_share_of_requests_as_a_canary(registry: Registry, served: tuple[TestClient, LocalHandle]) -> None:
    client, _ = served
    registry.traffic.set(LEAGUE, canary=Portion(SEARCH, 0.5), actor="test", reason="test")

    def versions() -> set[int]:
        callers = [
            client.post(PATH, json={"observation": BOARDS[0]}, headers={"x-league-key": str(i)}) for i in range(16)
        ]
        return {reply.json()["version"] for reply in callers}

    until(lambda: versions() == {1, SEARCH})


def test_the_leaderboard_shows_searches(registry: Registry, served: tuple[TestClient, LocalHandle]) -> None:
    standing = {"rating": None, "interval": None, "score": 0.5, "mean_return": None, "games": 2, "unique_games": None}
    rows = [standing | {"ref": ref} for ref in (f"{LEAGUE}@{SEARCH}", f"{LEAGUE}@1", "script:random")]
    document = {"sides": [], "leaderboard": rows, "by_side": {}, "not_champion": None}
    registry.snapshots.put(LEAGUE, {"leaderboard": document}, registry.snapshots.current_marks()[LEAGUE])
    client, _ = served
    searching, *others = client.get(f"/v1/leagues/{LEAGUE}/leaderboard").json()["leaderboard"]
    search = searching["search"]
    assert (search["version"], search["rule"], search["simulations"], search["ms"] > 0) == (1, "puct", 50, True)
    assert [row["search"] for row in others] == [None, None]


def test_a_search_version_is_promoted_and_rolled_back(
    registry: Registry, served: tuple[TestClient, LocalHandle]
) -> None:
    client, _ = served

    def champion() -> int:
        return int(client.post(PATH, json={"observation": BOARDS[0]}).json()["version"])

    until(lambda: champion() == 1)
    promote(registry, SEARCH)
    until(lambda: champion() == SEARCH)
    registry.aliases.rollback(LEAGUE, actor="test", reason="test")
    until(lambda: champion() == 1)


def test_it_is_compared_as_a_shadow(registry: Registry, served: tuple[TestClient, LocalHandle]) -> None:
    client, _ = served
    registry.traffic.set(LEAGUE, shadow=Portion(SEARCH, 1.0), actor="test", reason="test")

    def compared() -> float:
        client.post(PATH, json={"observation": BOARDS[1]})
        return value(client, "league_shadow_requests_total", league=LEAGUE)

    until(lambda: compared() > 0)
    assert value(client, "league_shadow_agreed_total", league=LEAGUE) >= 0


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


@pytest.mark.parametrize(
    ("body", "version", "message"),
    [
        ({"deadline_ms": 0}, SEARCH, "deadline_ms must be null or an integer from 1 to 86400000"),
        ({"analysis": True}, 1, "analysis is true, but this version does not search"),
        ({"observation": position((0, 1, 2)) | {OBSERVATION: [[[1, 1]] * 3] * 3}}, SEARCH, "not a position"),
    ],
)
def test_what_cannot_be_searched_is_refused(
    served: tuple[TestClient, LocalHandle], body: dict, version: int, message: str
) -> None:
    client, _ = served
    reply = client.post(f"{PATH}?version={version}", json={"observation": BOARDS[0]} | body)
    assert reply.status_code == 400
    assert message in reply.json()["message"]


def test_a_call_whose_process_ends_is_repeated(served: tuple[TestClient, LocalHandle]) -> None:
    client, handle = served
    assert client.post(f"{PATH}?version={SEARCH}", json={"observation": BOARDS[0]}).status_code == 200
    handle.deaths = 3
    assert client.post(f"{PATH}?version={SEARCH}", json={"observation": BOARDS[0]}).status_code == 200
    assert handle.deaths == 0
    until(lambda: handle.calls.count("stay") > 0)


def test_requests_that_wait_together_share_a_message(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    server, handle = searching_server(registry, monkeypatch)
    sizes, released, call = list[int](), asyncio.Event(), handle.call

    async def hold(method: str, *arguments: Any) -> Any:
        if method == "searches":
            sizes.append(len(arguments[0]))
            await released.wait()
        return await call(method, *arguments)

    with local_client(server) as client, ThreadPoolExecutor(10) as requests:

        def request(board: dict[str, list]) -> "Future[Response]":
            return requests.submit(client.post, f"{PATH}?version={SEARCH}", json={"observation": board})

        assert request(BOARDS[0]).result().status_code == 200
        version = server.versions.cached(LEAGUE, SEARCH)
        assert version is not None
        search = version.policy(None).search
        assert search is not None
        monkeypatch.setattr(handle, "call", hold)
        replies = [request(BOARDS[0]) for _ in range(MESSAGES)]
        until(lambda: sizes == [1] * MESSAGES)
        replies += [request(board) for board in 2 * BOARDS]
        until(lambda: len(search._queue.waiting) == 2 * len(BOARDS))
        assert client.portal is not None
        client.portal.call(released.set)
        answers = [reply.result().json() for reply in replies]
    assert sizes == [*[1] * MESSAGES, 2 * len(BOARDS)]
    assert [answer["simulations"] for answer in answers] == [50] * len(answers)
    assert [answer["action"] for answer in answers[MESSAGES:-4]] == [answer["action"] for answer in answers[-4:]]


def test_a_server_without_search_service_says_so(registry: Registry) -> None:
    with replica(registry.storage) as client:
        reply = client.post(f"{PATH}?version={SEARCH}", json={"observation": BOARDS[0]})
        assert (reply.status_code, reply.json()["code"]) == (503, "no_search_service")
        assert client.post(PATH, json={"observation": BOARDS[0]}).json()["version"] == 1
