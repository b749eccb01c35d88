"""Games over HTTP: requests and errors of the routes, answered by the worker processes of the evaluation service."""

from __future__ import annotations

import json
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator
from PIL import Image
from starlette.testclient import TestClient

from evaluation.matches.tournament import evaluate
from evaluation.service.game_worker_pool import GameWorkerPool
from league.environments.building import interface
from league.errors import GameHung, LeagueError, NoEvaluationService, NotReady, Overloaded, RemoteError, WorkerLost
from league.registry.registry import Registry
from league.results.ledger import Ledger
from league.results.records import Match
from league.search.policies import publish_search
from league.service_requests import GameRequest, GameResponse
from league.settings import Storage
from serve_app.app import Replica
from serve_app.openapi.document import document
from tests.support.leagues import tictactoe
from tests.support.policies.graphs import masked_mlp
from tests.support.servers.replicas import QUICK, UnavailableEvaluation, local_client
from tests.support.waiting import until

LEAGUE = "/v1/leagues/tictactoe"
PLAY = f"{LEAGUE}/play"


class LocalEvaluation:
    """An evaluation service in this process with real worker processes."""

    def __init__(self, pool: GameWorkerPool) -> None:
        self._pool = pool

    def notify(self) -> None:
        """Do nothing."""

    async def request_game(self, order: GameRequest) -> GameResponse:
        """Submit the request, like evaluation.service.deployment."""
        return await self._pool.submit(order, timeout=100.0)


class FailingEvaluation(UnavailableEvaluation):
    """An evaluation service that responds with an error."""

    def __init__(self, error: LeagueError) -> None:
        self._error = error

    async def request_game(self, order: GameRequest) -> GameResponse:
        """Raise the error."""
        raise self._error


SEARCH, LONG_SEARCH = 4, 5
"""Versions that search with few and with too many simulations."""


class RecordingEvaluation(UnavailableEvaluation):
    """An evaluation service that records the requests."""

    def __init__(self) -> None:
        self.requests: list[GameRequest] = []

    async def request_game(self, order: GameRequest) -> GameResponse:
        """Respond with an empty document."""
        self.requests.append(order)
        return GameResponse("application/json", b"{}")


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
def client(playable: Registry) -> Iterator[TestClient]:
    pool = GameWorkerPool()
    with pytest.MonkeyPatch.context() as patch:
        for name, value in playable.storage.environment.items():
            patch.setenv(name, value)
        server = Replica(Registry.open(playable.storage), QUICK, "replica-1", evaluation_client=LocalEvaluation(pool))
        with local_client(server) as client:
            yield client
    pool.close()


@pytest.fixture(scope="module")
def match(playable: Registry) -> Match:
    return Ledger(playable).matches(league=tictactoe.LEAGUE)[0]


def game(match: Match, number: int = 0) -> str:
    return f"{LEAGUE}/matches/{match.id}/games/{number}"


def play(client: TestClient, status: int = 200, **body: Any) -> dict[str, Any]:
    reply = client.post(PLAY, json={"opponent": "tictactoe@champion", "agent": "player_1"} | body)
    assert reply.status_code == status, reply.text
    return validated("PlayedGame" if status == 200 else "Error", reply.json())


def validated(kind: str, answer: dict[str, Any]) -> dict[str, Any]:
    """A response, validated with the schema of the OpenAPI document."""
    parts = {"$ref": f"#/components/schemas/{kind}", "components": document(QUICK, [])["components"]}
    Draft202012Validator(parts).validate(answer)
    return answer


def test_a_recorded_game_is_shown_step_by_step(client: TestClient, match: Match) -> None:
    recorded = validated("RecordedGame", client.get(game(match, 1)).json())
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
    part = client.get(game(match, 1), params={"from": 2, "to": 4, "every": 1}).json()
    assert part["steps"] == recorded["steps"][2:4]


def test_a_recorded_game_is_available_as_a_video(client: TestClient, match: Match) -> None:
    reply = client.get(f"{game(match)}/video.gif")
    assert reply.headers["content-type"] == "image/gif"
    name = match.id.replace("/", "-")
    assert reply.headers["content-disposition"] == f'attachment; filename="{name}-0.gif"'
    assert Image.open(BytesIO(reply.content)).n_frames == client.get(game(match)).json()["length"] + 1


def test_agents_and_opponents_are_listed(client: TestClient) -> None:
    playable_agents = validated("Playability", client.get(f"{LEAGUE}/playable").json())
    versions = [f"tictactoe@{number}" for number in range(LONG_SEARCH, 0, -1)]
    assert playable_agents["opponents"] == [*versions, "script:random", "script:one_ply"]
    assert [seat["agent"] for seat in playable_agents["agents"]] == ["player_1", "player_2"]
    assert (playable_agents["playable"], playable_agents["draws"]) == (True, True)
    assert playable_agents["board"] == [[0, 3, 6], [1, 4, 7], [2, 5, 8]]
    assert playable_agents["agents"][0] | {"color": "#6183e7", "names": {}, "keys": {}} == playable_agents["agents"][0]


def test_a_game_is_played_to_its_end(client: TestClient) -> None:
    actions: list[int] = []
    state = play(client, seed=3, chances=True)
    assert state["opponent"] == "tictactoe@2", "the champion is pinned by its number"
    while not state["over"]:
        assert state["picture"].startswith("data:image/png")
        assert sorted(action for action, _ in state["chances"]) == state["legal"]
        actions.append(state["legal"][-1])
        state = play(client, opponent=state["opponent"], seed=3, chances=True, actions=actions)
    assert state["score"] in (0.0, 0.5, 1.0)
    assert sum(state["returns"].values()) == 0
    moves = [move for step in state["steps"] for move in step["moves"]]
    assert [move["action"] for move in moves if move["ref"] == "person"] == actions


def test_an_illegal_choice_has_a_message_with_the_legal_ones(client: TestClient) -> None:
    error = play(client, status=422, opponent="script:first", actions=[4, 0])
    assert error == {
        "code": "illegal_action",
        "message": "actions[1]: 0 is illegal, expected one of 1, 2, 3, 5, 6, 7, 8",
    }


@pytest.mark.parametrize(
    ("body", "status", "code"),
    [
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
    ],
)
def test_invalid_games_are_rejected(client: TestClient, body: dict[str, Any], status: int, code: str) -> None:
    assert play(client, status=status, **body)["code"] == code


def test_a_search_version_evaluates_recorded_and_played_games(client: TestClient, match: Match) -> None:
    steps = client.get(f"{game(match)}?analysis={SEARCH}").json()["steps"]
    assert all(-1 <= move["value"] <= 1 for move in steps[-1]["moves"])
    assert [move["value"] for move in client.get(game(match)).json()["steps"][-1]["moves"]] == [None]
    state = play(client, opponent="script:first", seed=1, actions=[2, 4], analysis=SEARCH)
    assert state["chances"][0][0] == 6, "2, 4 and 6 are a line"
    assert state["value"] > 0.5
    assert play(client, opponent="script:first", seed=1, actions=[2, 4])["value"] is None
    against = play(client, opponent=f"tictactoe@{SEARCH}", agent="player_2", seed=1, chances=True)
    assert against["steps"][-1]["moves"][0]["value"] is not None
    assert sum(chance for _, chance in against["chances"]) == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize(
    ("path", "status", "code"),
    [
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
    ],
)
def test_unknown_games_are_reported(client: TestClient, match: Match, path: str, status: int, code: str) -> None:
    reply = client.get(path.format(match=f"{LEAGUE}/matches/{match.id}", id=match.id))
    assert (reply.status_code, reply.json()["code"]) == (status, code)


def test_a_league_without_matches_can_be_played_with_scripts(client: TestClient) -> None:
    body = {"opponent": "script:one_ply", "agent": "player_2"}
    state = client.post("/v1/leagues/other/play", json=body).json()
    assert [move["agent"] for step in state["steps"] for move in step["moves"]] == ["player_1"]


@pytest.mark.parametrize(
    ("error", "status", "code"),
    [
        (NoEvaluationService("it is away"), 503, "no_evaluation_service"),
        (NotReady("it takes longer"), 503, "not_ready"),
        (Overloaded("too many"), 429, "overloaded"),
        (GameHung("it hangs"), 504, "game_hung"),
        (WorkerLost("it died"), 500, "worker_lost"),
        (RemoteError("it is unreachable"), 502, "remote_error"),
    ],
)
def test_errors_of_the_evaluation_service_keep_their_status(
    playable: Registry, error: LeagueError, status: int, code: str
) -> None:
    server = Replica(Registry.open(playable.storage), QUICK, "replica-1", evaluation_client=FailingEvaluation(error))
    with local_client(server) as client:
        reply = client.get(f"{LEAGUE}/playable")
        assert (reply.status_code, reply.json()) == (status, {"code": code, "message": str(error)})
        assert ("retry-after" in reply.headers) == (status in (429, 503))


def test_games_under_other_conditions_are_other_requests(tmp_path: Path) -> None:
    """The evaluation service caches the responses."""
    registry, service = tictactoe.registry(tmp_path), RecordingEvaluation()
    server = Replica(Registry.open(registry.storage), QUICK, "replica-1", evaluation_client=service)
    with local_client(server) as client:
        for actions, plies in (("greedy", 2), (None, 2), ("sampled", 2), ("sampled", 3)):
            league = tictactoe.config(play={"actions": actions, "opening_plies": plies})
            registry.leagues.register(league, interface(league))
            reply = client.post(PLAY, json={"opponent": "script:random", "agent": "player_1"})
            assert reply.status_code == 200
    registry.close()
    first, same, sampled, longer = service.requests
    assert first == same
    assert len({each.model_dump_json() for each in (first, sampled, longer)}) == 3


def test_a_missing_evaluation_service_is_reported(playable: Registry) -> None:
    with local_client(Replica(Registry.open(playable.storage), QUICK, "replica-1")) as client:
        assert play(client, status=503)["code"] == "no_evaluation_service"


def test_playing_requires_the_scope_act_and_reading_the_scope_read(tmp_path_factory: pytest.TempPathFactory) -> None:
    registry = tictactoe.registry(tmp_path_factory.mktemp("keys"))
    keys = {scope: registry.keys.create(scope, [scope])[1] for scope in ("act", "read", "evaluate", "promote")}
    server = Replica(
        Registry.open(Storage.at(registry.storage.home)), QUICK, "replica-1", evaluation_client=UnavailableEvaluation()
    )
    with local_client(server) as client:
        for scope, token in keys.items():
            headers = {"x-api-key": token}
            until(lambda headers=headers: client.post(PLAY, json={}, headers=headers).status_code != 401)
            reply = client.post(PLAY, json={}, headers=headers)
            assert (reply.status_code == 403) == (scope != "act")
            assert (client.get(f"{LEAGUE}/playable", headers=headers).status_code == 403) == (scope != "read")
    registry.close()
    assert json.loads(reply.content)["code"] == "forbidden"
