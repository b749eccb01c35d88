"""Games over HTTP: what the routes take and refuse, and what processes like the studio's answer to it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import astuple
from io import BytesIO
from typing import Any

import pytest
from jsonschema import Draft202012Validator
from PIL import Image
from starlette.testclient import TestClient

from evaluation.stages import Stages
from evaluation.tournament import evaluate
from league.environments.building import interface
from league.errors import GameHung, LeagueError, NoStudio, NotReady, Overloaded, WorkerLost
from league.games import Order
from league.registry.registry import Registry
from league.results.ledger import Ledger
from league.results.records import Match
from league.settings import Storage
from serve_app.app import Server
from serve_app.openapi.document import document
from serve_app.studio import Answer
from tests.evaluation import examples
from tests.serve_app.conftest import QUICK, Closed

LEAGUE = "/v1/leagues/tictactoe"
PLAY = f"{LEAGUE}/play"
PATIENT = QUICK.model_copy(update={"timeout": 120.0})


class AtHome:
    """A studio in this process, whose stages are the real ones."""

    def __init__(self, stages: Stages) -> None:
        self._stages = stages

    def look(self) -> None:
        """There are no evaluations."""

    async def ask(self, order: Order) -> Answer:
        """As evaluation.studio does."""
        return Answer(*astuple(await self._stages.ask(order, patience=100.0)))


class Refusing(Closed):
    """A studio that answers by an error."""

    def __init__(self, error: LeagueError) -> None:
        self._error = error

    async def ask(self, order: Order) -> Answer:
        """Refuse."""
        raise self._error


@pytest.fixture(scope="module")
def playable(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Registry]:
    """Tic-tac-toe with a champion and a match, and another league without."""
    registry = examples.registry(tmp_path_factory.mktemp("games") / "home")
    for graph in (examples.graph(), examples.graph(wins=True)):
        examples.publish(registry, graph)
    registry.set_alias(examples.LEAGUE, "champion", 2, expected=None, actor="test", reason="test")
    evaluate(examples.LEAGUE, ["tictactoe@1", "tictactoe@2"], registry=registry, blocks=1)
    other = examples.config(league="other")
    registry.register(other, interface(other))
    yield registry
    registry.close()


@pytest.fixture(scope="module")
def client(playable: Registry) -> Iterator[TestClient]:
    stages = Stages()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LEAGUE_HOME", str(playable.storage.home))
        patch.setenv("LEAGUE_DATABASE_URL", playable.storage.database_url)
        patch.setenv("LEAGUE_ARTIFACTS", str(playable.storage.artifacts))
        server = Server(Registry.open(playable.storage), PATIENT, "replica-1", studio=AtHome(stages))
        with TestClient(server.application()) as client:
            yield client
    stages.close()


@pytest.fixture(scope="module")
def match(playable: Registry) -> Match:
    return Ledger(playable).matches(league=examples.LEAGUE)[0]


def game(match: Match, number: int = 0) -> str:
    return f"{LEAGUE}/matches/{match.id}/games/{number}"


def played(client: TestClient, status: int = 200, **body: Any) -> dict[str, Any]:
    reply = client.post(PLAY, json={"opponent": "tictactoe@champion", "agent": "player_1"} | body)
    assert reply.status_code == status, reply.text
    return described("PlayedGame" if status == 200 else "Error", reply.json())


def described(kind: str, answer: dict[str, Any]) -> dict[str, Any]:
    """An answer that is what the description says."""
    parts = {"$ref": f"#/components/schemas/{kind}", "components": document(QUICK, [])["components"]}
    Draft202012Validator(parts).validate(answer)
    return answer


def test_a_recorded_game_is_shown_step_by_step(client: TestClient, match: Match) -> None:
    book = described("RecordedGame", client.get(game(match, 1)).json())
    record = match.games[1]
    assert (book["match"], book["game"], book["fault"]) == (match.id, 1, None)
    assert [move["action"] for step in book["steps"] for move in step["moves"]] == [
        *record.opening,
        *record.actions,
    ]
    assert len(book["steps"]) == book["length"] + 1
    assert book["cast"] == {f"player_{i + 1}": match.contestants[c] for i, c in enumerate(record.sides)}
    last = book["steps"][-1]["moves"][0]
    assert last["chances"][0][0] == last["action"]
    part = client.get(game(match, 1), params={"from": 2, "to": 4, "every": 1}).json()
    assert part["steps"] == book["steps"][2:4]


def test_a_recorded_game_is_a_film_to_keep(client: TestClient, match: Match) -> None:
    reply = client.get(f"{game(match)}/film.gif")
    assert reply.headers["content-type"] == "image/gif"
    name = match.id.replace("/", "-")
    assert reply.headers["content-disposition"] == f'attachment; filename="{name}-0.gif"'
    assert Image.open(BytesIO(reply.content)).n_frames == client.get(game(match)).json()["length"] + 1


def test_it_tells_as_whom_and_against_whom_to_play(client: TestClient) -> None:
    table = described("Playable", client.get(f"{LEAGUE}/playable").json())
    assert table["opponents"] == ["tictactoe@2", "tictactoe@1", "script:random", "script:one_ply"]
    assert [seat["agent"] for seat in table["agents"]] == ["player_1", "player_2"]
    assert (table["playable"], table["draws"]) == (True, True)


def test_a_game_is_played_to_its_end_by_whoever_holds_its_choices(client: TestClient) -> None:
    actions: list[int] = []
    sat = played(client, seed=3, chances=True)
    assert sat["opponent"] == "tictactoe@2", "the champion of this moment, by its number"
    while not sat["over"]:
        assert sat["picture"].startswith("data:image/png")
        assert sorted(action for action, _ in sat["chances"]) == sat["legal"]
        actions.append(sat["legal"][-1])
        sat = played(client, opponent=sat["opponent"], seed=3, chances=True, actions=actions)
    assert sat["score"] in (0.0, 0.5, 1.0)
    assert sum(sat["returns"].values()) == 0
    moves = [move for step in sat["steps"] for move in step["moves"]]
    assert [move["action"] for move in moves if move["ref"] == "person"] == actions


def test_an_illegal_choice_names_the_legal_ones(client: TestClient) -> None:
    error = played(client, status=422, opponent="script:first", actions=[4, 0])
    assert error == {
        "code": "illegal_action",
        "message": "actions: 0, number 2 of them, is illegal there; legal are 1, 2, 3, 5, 6, 7, 8",
    }


@pytest.mark.parametrize(
    ("body", "status", "code"),
    [
        ({"agent": "white"}, 400, "invalid_input"),
        ({"opponent": "tictactoe@9"}, 404, "unknown_version"),
        ({"opponent": "tictactoe@candidate"}, 404, "unknown_alias"),
        ({"opponent": "script:clever"}, 404, "unknown_policy"),
        ({"opponent": "other@1"}, 400, "environment_mismatch"),
        ({"opponent": "tictactoe"}, 400, "invalid_reference"),
        ({"seed": -1}, 400, "invalid_input"),
        ({"actions": ["4"]}, 400, "invalid_input"),
        ({"actions": [2**63]}, 400, "invalid_input"),
        ({"actions": [0] * 10_001}, 400, "invalid_input"),
        ({"opponent": "script:first", "actions": [2, 4, 6, 8]}, 400, "invalid_input"),
        ({"kind": "table"}, 400, "invalid_input"),
        ({"chances": 1}, 400, "invalid_input"),
    ],
)
def test_what_cannot_be_played_is_refused(client: TestClient, body: dict[str, Any], status: int, code: str) -> None:
    assert played(client, status=status, **body)["code"] == code


@pytest.mark.parametrize(
    ("path", "status", "code"),
    [
        (f"{LEAGUE}/matches/nowhere/0/games/0", 404, "unknown_match"),
        (f"{LEAGUE}/matches/nowhere/x/games/0", 404, "unknown_match"),
        ("{match}/games/2", 404, "unknown_match"),
        ("{match}/games/-1", 404, "unknown_match"),
        ("{match}/games/99999999999", 404, "unknown_match"),
        ("{match}/games/2/film.gif", 404, "unknown_match"),
        ("/v1/leagues/other/matches/{id}/games/0", 404, "unknown_match"),
        ("/v1/leagues/chess/matches/{id}/games/0", 404, "unknown_league"),
        ("/v1/leagues/chess/playable", 404, "unknown_league"),
        ("{match}/games/0?from=-1", 400, "invalid_input"),
        ("{match}/games/0?every=0", 400, "invalid_input"),
        ("{match}/games/0?to=99999999999", 400, "invalid_input"),
    ],
)
def test_what_is_not_there_is_not_shown(client: TestClient, match: Match, path: str, status: int, code: str) -> None:
    reply = client.get(path.format(match=f"{LEAGUE}/matches/{match.id}", id=match.id))
    assert (reply.status_code, reply.json()["code"]) == (status, code)


def test_a_league_that_nobody_has_played_is_playable_by_scripts(client: TestClient) -> None:
    body = {"opponent": "script:one_ply", "agent": "player_2"}
    sat = client.post("/v1/leagues/other/play", json=body).json()
    assert [move["agent"] for step in sat["steps"] for move in step["moves"]] == ["player_1"]


@pytest.mark.parametrize(
    ("error", "status", "code"),
    [
        (NoStudio("it is away"), 503, "no_studio"),
        (NotReady("it takes longer"), 503, "not_ready"),
        (Overloaded("too many"), 429, "overloaded"),
        (GameHung("it hangs"), 504, "game_hung"),
        (WorkerLost("it died"), 500, "worker_lost"),
    ],
)
def test_what_the_studio_says_is_answered_by_its_status(
    playable: Registry, error: LeagueError, status: int, code: str
) -> None:
    server = Server(Registry.open(playable.storage), QUICK, "replica-1", studio=Refusing(error))
    with TestClient(server.application()) as client:
        reply = client.get(f"{LEAGUE}/playable")
        assert (reply.status_code, reply.json()) == (status, {"code": code, "message": str(error)})
        assert ("retry-after" in reply.headers) == (status in (429, 503))


def test_a_server_without_a_studio_says_so(playable: Registry) -> None:
    with TestClient(Server(Registry.open(playable.storage), QUICK, "replica-1").application()) as client:
        assert played(client, status=503)["code"] == "no_studio"


def test_playing_takes_a_key_that_acts_and_looking_one_that_reads(tmp_path_factory: pytest.TempPathFactory) -> None:
    registry = examples.registry(tmp_path_factory.mktemp("keys"))
    keys = {scope: registry.create_key(scope, [scope])[1] for scope in ("act", "read", "evaluate", "promote")}
    server = Server(Registry.open(Storage.at(registry.storage.home)), QUICK, "replica-1", studio=Closed())
    with TestClient(server.application()) as client:
        for scope, token in keys.items():
            headers = {"x-api-key": token}
            while (reply := client.post(PLAY, json={}, headers=headers)).status_code == 401:
                pass
            assert (reply.status_code == 403) == (scope != "act")
            assert (client.get(f"{LEAGUE}/playable", headers=headers).status_code == 403) == (scope != "read")
    registry.close()
    assert json.loads(reply.content)["code"] == "forbidden"
