"""The routes that list leagues, versions and health."""

import pytest
from starlette.testclient import TestClient

from league.registry.registry import Registry
from league.settings import Storage


def test_leagues(read_only_client: TestClient) -> None:
    leagues = {league["league"]: league for league in read_only_client.get("/v1/leagues").json()["leagues"]}
    assert list(leagues) == ["board", "duo", "empty", "headless", "memory", "nested", "vector"]
    assert (leagues["board"]["champion"], leagues["board"]["aliases"]) == (1, {"champion": 1})
    assert (leagues["empty"]["champion"], leagues["empty"]["aliases"]) == (None, {})


def test_a_league(read_only_client: TestClient) -> None:
    league = read_only_client.get("/v1/leagues/duo").json()
    assert (league["league"], league["champion"], league["faults"]) == ("duo", 1, [])
    assert league["agents"] == {"agent_left": "left", "agent_right": "right"}
    assert league["policies"]["left"]["action"]["n"] == 7
    assert league["baselines"] == ["script:random", "script:one_ply"]
    (row,) = read_only_client.get("/v1/leagues/empty").json()["replicas"]
    assert (row["replica"], row["version"], row["aliases"], row["event"]) == ("replica-1", None, {}, None)
    assert row["silent_seconds"] < 60


def test_versions(read_only_client: TestClient, storage: Storage) -> None:
    registry = Registry.open(storage)
    versions = read_only_client.get("/v1/leagues/board/versions").json()["versions"]
    assert [version["version"] for version in versions] == [1, 2, 3]
    assert [version["aliases"] for version in versions] == [["champion"], [], []]
    assert versions[1]["sha256"] == registry.versions.get("board", 2).sha256
    assert versions[0]["policies"] == ["shared"]
    assert read_only_client.get("/v1/leagues/empty/versions").json()["versions"] == []
    registry.close()


def test_a_version(read_only_client: TestClient) -> None:
    versions = read_only_client.get("/v1/leagues/board/versions").json()["versions"]
    assert read_only_client.get("/v1/leagues/board/versions/2").json() == versions[1]
    assert read_only_client.get("/v1/leagues/board/versions/champion").json() == versions[0]


@pytest.mark.parametrize(
    ("version", "status", "code"),
    [("9", 404, "unknown_version"), ("nobody", 404, "unknown_alias"), ("NO", 400, "invalid_reference")],
)
def test_an_unknown_version_is_reported(read_only_client: TestClient, version: str, status: int, code: str) -> None:
    reply = read_only_client.get(f"/v1/leagues/board/versions/{version}")
    assert (reply.status_code, reply.json()["code"]) == (status, code)


@pytest.mark.parametrize("path", ["/v1/leagues/nobody", "/v1/leagues/nobody/versions", "/v1/leagues/nobody/versions/1"])
def test_an_unknown_league_is_reported(read_only_client: TestClient, path: str) -> None:
    reply = read_only_client.get(path)
    assert (reply.status_code, reply.json()["code"]) == (404, "unknown_league")
    assert "board" in reply.json()["message"], "the known leagues are listed"


def test_an_invalid_league_name_is_rejected(read_only_client: TestClient) -> None:
    reply = read_only_client.get("/v1/leagues/NO")
    assert (reply.status_code, reply.json()["code"]) == (400, "invalid_reference")


def test_leagues_are_read_only(read_only_client: TestClient) -> None:
    assert read_only_client.post("/v1/leagues").json()["code"] == "method_not_allowed"


def test_health(read_only_client: TestClient) -> None:
    assert read_only_client.get("/v1/health/live").json() == {"status": "live", "replica": "replica-1"}
    assert read_only_client.get("/v1/health/ready").json() == {"status": "ready", "replica": "replica-1"}
