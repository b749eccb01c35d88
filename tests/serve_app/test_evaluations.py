"""Evaluations over HTTP, and games, answered by the worker processes of the evaluation service."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any
from unittest.mock import AsyncMock, Mock

import pytest
from jsonschema import Draft202012Validator
from PIL import Image
from starlette.testclient import TestClient

from evaluation.matches.tournament import evaluate
from evaluation.service.game_worker_pool import GameWorkerPool
from league.environments.building import interface
from league.errors import GameHung, NoEvaluationService, Overloaded, RemoteError
from league.registry.registry import Registry
from league.results.ledger import Ledger
from league.results.records import Match
from league.search.policies import publish_search
from league.service_requests import GameResponse
from serve_app.app import Replica
from serve_app.openapi.document import document
from tests.support.databases import on_both_databases
from tests.support.leagues import tictactoe
from tests.support.leagues.served_leagues import promote
from tests.support.policies.graphs import masked_mlp
from tests.support.servers.replicas import QUICK, local_client, replica
from tests.support.waiting import until

BOARD = "/v1/leagues/board/evaluations"


@pytest.fixture
def evaluator(client: TestClient, registry: Registry) -> TestClient:
    """The client with a key that may start evaluations, but not nightly runs."""
    return with_key(client, registry, "bot", ["evaluate", "read"])


def with_key(client: TestClient, registry: Registry, name: str, scopes: list[str]) -> TestClient:
    _, token = registry.keys.create(name, scopes)
    client.headers["x-api-key"] = token
    until(lambda: client.get("/v1/leagues").status_code != 401)
    until(lambda: client.post(BOARD, content=b"x").status_code != 401)
    return client


def start(
    client: TestClient, body: Any = None, call: str = "a", path: str = BOARD, status: int = 202
) -> dict[str, Any]:
    content = {"content": body} if isinstance(body, bytes) else {"json": body or {}}
    reply = client.post(path, headers={"idempotency-key": call}, **content)
    assert reply.status_code == status, reply.text
    return dict(reply.json())


def test_replicas_start_the_service_for_an_interrupted_evaluation(registry: Registry) -> None:
    registry.evaluations.submit("board", {"kind": "tournament"}, actor="bot", reason="test", max_active=1)
    registry.evaluations.claim("a process that has ended", workers=1)
    service = Mock()
    with local_client(Replica(Registry.open(registry.storage), QUICK, "replica-1", evaluation_client=service)):
        until(lambda: service.notify.called)


@on_both_databases
def test_a_submitted_evaluation_is_queued_with_pinned_references(evaluator: TestClient, registry: Registry) -> None:
    body = {"contestants": ["board@champion", "board@3", "script:random"], "blocks": 4, "reason": "try"}
    reply = evaluator.post(BOARD, json=body, headers={"idempotency-key": "a"})
    document = reply.json()
    promote(registry, "board", 2)
    assert (reply.status_code, reply.headers["location"]) == (202, f"{BOARD}/{document['evaluation']}")
    request = {"kind": "tournament", "schedule": "round_robin", "against": [], "blocks": 4, "seed": 0}
    request |= dict.fromkeys(("games", "minutes", "precision"))
    assert document["request"] == request | {"contestants": ["board@1", "board@3", "script:random"]}
    assert (document["state"], document["actor"], document["reason"]) == ("queued", "bot", "try")
    assert evaluator.get(reply.headers["location"]).json() == document


INVALID: tuple[tuple[Any, int, str], ...] = (
    ({"contestants": ["board@9"]}, 404, "unknown_version"),
    ({"contestants": ["board@candidate"]}, 404, "unknown_alias"),
    ({"contestants": ["script:os:system"]}, 404, "unknown_policy"),
    ({"contestants": ["script:clever"]}, 404, "unknown_policy"),
    ({"contestants": ["memory@1"]}, 400, "environment_mismatch"),
    ({"contestants": ["board"]}, 400, "invalid_reference"),
    ({"contestants": "board@1"}, 400, "invalid_input"),
    ({"contestants": ["board@1"] * 300}, 400, "invalid_input"),
    ({"blocks": 0}, 400, "invalid_input"),
    ({"blocks": "4"}, 400, "invalid_input"),
    ({"seed": 2**63}, 400, "invalid_input"),
    ({"games": 2**70}, 400, "invalid_input"),
    ({"minutes": 1e300}, 400, "invalid_input"),
    ({"game": 100}, 400, "invalid_input"),
    ({"games": 1}, 400, "invalid_input"),
    ({"against": ["script:random"]}, 400, "invalid_input"),
    ({"schedule": "cross_play", "precision": 20}, 400, "invalid_input"),
    ({"schedule": "gauntlet", "against": ["script:nobody"]}, 404, "unknown_policy"),
    ({"schedule": "lottery"}, 400, "invalid_input"),
    ({"kind": "yearly"}, 400, "invalid_input"),
    ({"kind": "nightly", "blocks": 4}, 400, "invalid_input"),
    ({"kind": "nightly"}, 403, "forbidden"),
    (b"[1]", 400, "invalid_input"),
    (b"nonsense", 400, "invalid_input"),
)


def test_invalid_evaluations_are_rejected_at_once(
    evaluator: TestClient, registry: Registry, subtests: pytest.Subtests
) -> None:
    for body, status, code in INVALID:
        with subtests.test(body=body):
            assert start(evaluator, body, status=status)["code"] == code
    for body, message in (
        ({"kind": "yearly"}, "kind must be 'tournament' or 'nightly'"),
        ({"blocks": 0}, "blocks: Input should be greater than or equal to 1"),
        ({"contestants": ["memory@1"]}, "memory@1 is not a version of league board"),
    ):
        assert message in start(evaluator, body, status=400)["message"]
    assert start(evaluator, path="/v1/leagues/chess/evaluations", status=404)["code"] == "unknown_league"
    vector = {"contestants": ["script:one_ply"]}
    error = start(evaluator, vector, path="/v1/leagues/vector/evaluations", status=400)
    assert error["code"] == "environment_mismatch"
    for query in ("limit=0", "limit=101", "limit=x", "before=-1", "before=99999999999"):
        assert evaluator.get(f"{BOARD}?{query}").json()["code"] == "invalid_input"
    assert registry.evaluations.newest("board") == []


def test_a_nightly_run_requires_a_key_that_may_promote(client: TestClient, registry: Registry) -> None:
    promoter = with_key(client, registry, "owl", ["evaluate", "promote"])
    assert start(promoter, {"kind": "nightly"})["request"] == {"kind": "nightly"}


def test_other_keys_cannot_start_or_stop_evaluations(client: TestClient, registry: Registry) -> None:
    assert client.get(BOARD).json() == {"league": "board", "evaluations": [], "next": None}
    assert start(client, status=401)["code"] == "unauthenticated", "a key is always required"
    assert client.delete(f"{BOARD}/1").status_code == 401
    other = with_key(client, registry, "other", ["read", "act", "promote"])
    start(other, status=403)
    assert other.delete(f"{BOARD}/1").status_code == 403


@on_both_databases
def test_a_repeated_call_starts_nothing(evaluator: TestClient, registry: Registry) -> None:
    first = start(evaluator, {"blocks": 4})
    assert start(evaluator, b' {"blocks" : 4} ') == first
    assert start(evaluator, {"blocks": 5}, status=409)["code"] == "idempotency_key_reused"
    assert evaluator.post(BOARD, json={}).status_code == 400, "an idempotency key is required"
    assert len(registry.evaluations.newest("board")) == 1


@on_both_databases
def test_evaluations_are_paginated_newest_first(evaluator: TestClient) -> None:
    numbers = [start(evaluator, call=str(i))["evaluation"] for i in range(5)]
    page = evaluator.get(BOARD, params={"limit": 2}).json()
    assert [row["evaluation"] for row in page["evaluations"]] == numbers[:2:-1]
    assert "result" not in page["evaluations"][0]
    page = evaluator.get(BOARD, params={"before": page["next"], "limit": 3}).json()
    assert ([row["evaluation"] for row in page["evaluations"]], page["next"]) == (numbers[2::-1], None)


@on_both_databases
def test_a_queued_evaluation_is_stopped_at_once_and_once(evaluator: TestClient) -> None:
    number = start(evaluator)["evaluation"]
    stopped = evaluator.delete(f"{BOARD}/{number}")
    assert (stopped.status_code, stopped.json()["state"], stopped.json()["stopped_by"]) == (200, "stopped", "bot")
    assert evaluator.delete(f"{BOARD}/{number}").json() == stopped.json()


@on_both_databases
def test_an_unknown_evaluation_is_reported(evaluator: TestClient) -> None:
    number = start(evaluator, b"")["evaluation"]
    contestants = evaluator.get(f"{BOARD}/{number}").json()["request"]["contestants"]
    assert contestants == ["board@1", "board@2", "board@3"], "by default all versions"
    for path in (
        f"/v1/leagues/memory/evaluations/{number}",
        *(f"{BOARD}/{n}" for n in ("7", "0", "x", "9" * 20, "-1")),
    ):
        for reply in (evaluator.get(path), evaluator.delete(path)):
            assert (reply.status_code, reply.json()["code"]) == (404, "unknown_evaluation"), path


@on_both_databases
def test_the_number_of_active_evaluations_is_limited(registry: Registry) -> None:
    with replica(registry.storage, QUICK.model_copy(update={"max_evaluations": 2})) as client:
        evaluator = with_key(client, registry, "bot", ["evaluate", "read"])
        first = start(evaluator, call="a")["evaluation"]
        start(evaluator, call="b")
        assert start(evaluator, call="c", status=429)["code"] == "too_many_evaluations"
        assert 'league_evaluations{league="board",replica="",state="queued"} 2.0' in evaluator.get("/metrics").text
        evaluator.delete(f"{BOARD}/{first}")
        start(evaluator, call="c")
    with local_client(Replica(Registry.open(registry.storage), QUICK, "replica-1")) as client:
        client.headers["x-api-key"] = evaluator.headers["x-api-key"]
        assert start(client, call="d", status=503)["code"] == "no_evaluation_service"
        assert len(client.get(BOARD).json()["evaluations"]) == 3, "nothing was started"


LEAGUE = "/v1/leagues/tictactoe"
PLAY = f"{LEAGUE}/play"


SEARCH, LONG_SEARCH = 4, 5
"""Versions that search with few and with too many simulations."""


@pytest.fixture(scope="module")
def playable(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Registry]:
    """Tic-tac-toe with a champion and a match, and another league without either."""
    registry = tictactoe.registry(tmp_path_factory.mktemp("games") / "home")
    for graph in (tictactoe.graph(), tictactoe.graph(wins=True)):
        tictactoe.publish(registry, graph)
    base = tictactoe.publish(registry, masked_mlp((3, 3, 2), 9), value=masked_mlp((3, 3, 2), 9, has_value=True))
    league = registry.leagues.get(tictactoe.LEAGUE)
    for simulations in (50, 5000):
        publish_search(registry, base, league.config.environment, league.interface, "puct", simulations)
    registry.aliases.set(tictactoe.LEAGUE, "champion", 2, expected=None, actor="test", reason="test")
    evaluate(tictactoe.LEAGUE, ["tictactoe@1", "tictactoe@2"], registry=registry, blocks=1)
    other = tictactoe.config(league="other")
    registry.leagues.register(other, interface(other))
    yield registry
    registry.close()


@pytest.fixture(scope="module")
def games(playable: Registry) -> Iterator[TestClient]:
    pool = GameWorkerPool()
    with pytest.MonkeyPatch.context() as patch:
        for name, value in playable.storage.environment.items():
            patch.setenv(name, value)
        service = Mock(request_game=partial(pool.submit, timeout=100.0))  # as evaluation.service.deployment
        server = Replica(Registry.open(playable.storage), QUICK, "replica-1", evaluation_client=service)
        with local_client(server) as games:
            yield games
    pool.close()


@pytest.fixture(scope="module")
def match(playable: Registry) -> Match:
    return Ledger(playable).matches(league=tictactoe.LEAGUE)[0]


def game(match: Match, number: int = 0) -> str:
    return f"{LEAGUE}/matches/{match.id}/games/{number}"


def play(games: TestClient, status: int = 200, **body: Any) -> dict[str, Any]:
    reply = games.post(PLAY, json={"opponent": "tictactoe@champion", "agent": "player_1"} | body)
    assert reply.status_code == status, reply.text
    return validated("PlayedGame" if status == 200 else "Error", reply.json())


def validated(kind: str, answer: dict[str, Any]) -> dict[str, Any]:
    """A response, validated with the schema of the OpenAPI document."""
    parts = {"$ref": f"#/components/schemas/{kind}", "components": document(QUICK, [])["components"]}
    Draft202012Validator(parts).validate(answer)
    return answer


def test_a_recorded_game_is_shown_step_by_step(games: TestClient, match: Match) -> None:
    recorded = validated("RecordedGame", games.get(game(match, 1)).json())
    record = match.games[1]
    assert (recorded["match"], recorded["game"], recorded["fault"]) == (match.id, 1, None)
    assert [move["action"] for step in recorded["steps"] for move in step["moves"]] == [
        *record.opening,
        *record.actions,
    ]
    assert len(recorded["steps"]) == recorded["length"] + 1
    assert recorded["players"] == {f"player_{i + 1}": match.contestants[c] for i, c in enumerate(record.sides)}
    last = recorded["steps"][-1]["moves"][0]
    assert last["chances"][0][0] == last["action"]
    part = games.get(game(match, 1), params={"from": 2, "to": 4, "every": 1}).json()
    assert part["steps"] == recorded["steps"][2:4]


def test_a_recorded_game_is_available_as_a_video(games: TestClient, match: Match) -> None:
    reply = games.get(f"{game(match)}/video.gif")
    assert reply.headers["content-type"] == "image/gif"
    name = match.id.replace("/", "-")
    assert reply.headers["content-disposition"] == f'attachment; filename="{name}-0.gif"'
    assert Image.open(BytesIO(reply.content)).n_frames == games.get(game(match)).json()["length"] + 1


def test_agents_and_opponents_are_listed(games: TestClient) -> None:
    playable_agents = validated("Playability", games.get(f"{LEAGUE}/playable").json())
    versions = [f"tictactoe@{number}" for number in range(LONG_SEARCH, 0, -1)]
    assert playable_agents["opponents"] == [*versions, "script:random", "script:one_ply"]
    assert [seat["agent"] for seat in playable_agents["agents"]] == ["player_1", "player_2"]
    assert (playable_agents["playable"], playable_agents["draws"]) == (True, True)
    assert playable_agents["board"] == [[0, 3, 6], [1, 4, 7], [2, 5, 8]]
    assert playable_agents["agents"][0] | {"color": "#6183e7", "names": {}, "keys": {}} == playable_agents["agents"][0]


def test_a_game_is_played_to_its_end(games: TestClient) -> None:
    actions: list[int] = []
    state = play(games, seed=3, chances=True)
    assert state["opponent"] == "tictactoe@2", "the champion is pinned by its number"
    while not state["over"]:
        assert state["picture"].startswith("data:image/png")
        assert sorted(action for action, _ in state["chances"]) == state["legal"]
        actions.append(state["legal"][-1])
        state = play(games, opponent=state["opponent"], seed=3, chances=True, actions=actions)
    assert state["score"] in (0.0, 0.5, 1.0)
    assert sum(state["returns"].values()) == 0
    moves = [move for step in state["steps"] for move in step["moves"]]
    assert [move["action"] for move in moves if move["ref"] == "person"] == actions


INVALID_GAMES: tuple[tuple[dict[str, Any], int, str], ...] = (
    ({"agent": "white"}, 400, "invalid_input"),
    ({"opponent": "tictactoe@9"}, 404, "unknown_version"),
    ({"opponent": "tictactoe@candidate"}, 404, "unknown_alias"),
    ({"opponent": "script:clever"}, 404, "unknown_policy"),
    ({"opponent": "script:os:system"}, 404, "unknown_policy"),
    ({"opponent": "other@1"}, 400, "environment_mismatch"),
    ({"opponent": "tictactoe"}, 400, "invalid_reference"),
    ({"seed": -1}, 400, "invalid_input"),
    ({"actions": ["4"]}, 400, "invalid_input"),
    ({"actions": [2**63]}, 400, "invalid_input"),
    ({"actions": [0] * 10_001}, 400, "invalid_input"),
    ({"opponent": "script:first", "actions": [2, 4, 6, 8]}, 400, "invalid_input"),
    ({"kind": "table"}, 400, "invalid_input"),
    ({"chances": 1}, 400, "invalid_input"),
    ({"analysis": 1}, 400, "invalid_input"),
    ({"analysis": LONG_SEARCH}, 400, "invalid_input"),
    ({"analysis": 99}, 404, "unknown_version"),
)


def test_invalid_games_are_rejected(games: TestClient, subtests: pytest.Subtests) -> None:
    for body, status, code in INVALID_GAMES:
        with subtests.test(body=body):
            assert play(games, status=status, **body)["code"] == code
    error = play(games, status=422, opponent="script:first", actions=[4, 0])
    message = "actions[1]: 0 is illegal, expected one of 1, 2, 3, 5, 6, 7, 8"
    assert error == {"code": "illegal_action", "message": message}


def test_a_search_version_evaluates_recorded_and_played_games(games: TestClient, match: Match) -> None:
    steps = games.get(f"{game(match)}?analysis={SEARCH}").json()["steps"]
    assert all(-1 <= move["value"] <= 1 for move in steps[-1]["moves"])
    assert [move["value"] for move in games.get(game(match)).json()["steps"][-1]["moves"]] == [None]
    state = play(games, opponent="script:first", seed=1, actions=[2, 4], analysis=SEARCH)
    assert state["chances"][0][0] == 6, "2, 4 and 6 are a line"
    assert state["value"] > 0.5
    assert play(games, opponent="script:first", seed=1, actions=[2, 4])["value"] is None
    against = play(games, opponent=f"tictactoe@{SEARCH}", agent="player_2", seed=1, chances=True)
    assert against["steps"][-1]["moves"][0]["value"] is not None
    assert sum(chance for _, chance in against["chances"]) == pytest.approx(1, abs=1e-4)


UNKNOWN = (
    (f"{LEAGUE}/matches/nowhere/0/games/0", 404, "unknown_match"),
    (f"{LEAGUE}/matches/nowhere/x/games/0", 404, "unknown_match"),
    ("{match}/games/2", 404, "unknown_match"),
    ("{match}/games/-1", 404, "unknown_match"),
    ("{match}/games/99999999999", 404, "unknown_match"),
    ("{match}/games/2/video.gif", 404, "unknown_match"),
    ("/v1/leagues/other/matches/{id}/games/0", 404, "unknown_match"),
    ("/v1/leagues/chess/matches/{id}/games/0", 404, "unknown_league"),
    ("/v1/leagues/chess/playable", 404, "unknown_league"),
    ("{match}/games/0?from=-1", 400, "invalid_input"),
    ("{match}/games/0?every=0", 400, "invalid_input"),
    ("{match}/games/0?to=99999999999", 400, "invalid_input"),
    ("{match}/games/0?analysis=1", 400, "invalid_input"),
    ("{match}/games/0?analysis=99", 404, "unknown_version"),
)


def test_unknown_games_are_reported(games: TestClient, match: Match, subtests: pytest.Subtests) -> None:
    for path, status, code in UNKNOWN:
        with subtests.test(path):
            reply = games.get(path.format(match=f"{LEAGUE}/matches/{match.id}", id=match.id))
            assert (reply.status_code, reply.json()["code"]) == (status, code)


def test_errors_of_the_evaluation_service_keep_their_status(playable: Registry) -> None:
    service = Mock(request_game=AsyncMock())
    with local_client(
        Replica(Registry.open(playable.storage), QUICK, "replica-1", evaluation_client=service)
    ) as client:
        for error, status in (
            (NoEvaluationService("it is away"), 503),
            (Overloaded("too many"), 429),
            (GameHung("it hangs"), 504),
            (RemoteError("it is unreachable"), 502),
        ):
            service.request_game.side_effect = error
            reply = client.get(f"{LEAGUE}/playable")
            assert (reply.status_code, reply.json()) == (status, {"code": error.code, "message": str(error)})
            assert ("retry-after" in reply.headers) == (status in (429, 503))
    with local_client(Replica(Registry.open(playable.storage), QUICK, "replica-1")) as client:
        assert play(client, status=503)["code"] == "no_evaluation_service"


def test_games_under_other_conditions_are_other_requests(tmp_path: Path) -> None:
    """The evaluation service caches the responses."""
    registry, answer = tictactoe.registry(tmp_path), AsyncMock(return_value=GameResponse("application/json", b"{}"))
    service = Mock(request_game=answer)
    server = Replica(Registry.open(registry.storage), QUICK, "replica-1", evaluation_client=service)
    with local_client(server) as client:
        for actions, plies in (("greedy", 2), (None, 2), ("sampled", 2), ("sampled", 3)):
            league = tictactoe.config(play={"actions": actions, "opening_plies": plies})
            registry.leagues.register(league, interface(league))
            reply = client.post(PLAY, json={"opponent": "script:random", "agent": "player_1"})
            assert reply.status_code == 200
    registry.close()
    first, same, sampled, longer = (call.args[0] for call in answer.await_args_list)
    assert first == same
    assert len({request.model_dump_json() for request in (first, sampled, longer)}) == 3


def test_playing_requires_the_scope_act_and_reading_the_scope_read(tmp_path: Path) -> None:
    registry = tictactoe.registry(tmp_path)
    keys = {scope: registry.keys.create(scope, [scope])[1] for scope in ("act", "read", "evaluate", "promote")}
    with replica(registry.storage) as client:
        for scope, token in keys.items():
            played, read = (
                client.request(method, path, json={}, headers={"x-api-key": token})
                for method, path in (("POST", PLAY), ("GET", f"{LEAGUE}/playable"))
            )
            assert [reply.status_code == 403 for reply in (played, read)] == [scope != "act", scope != "read"]
    registry.close()
    assert read.json()["code"] == "forbidden"
