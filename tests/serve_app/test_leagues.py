"""What there is to ask for."""

import pytest
from starlette.testclient import TestClient

from league.registry.registry import Registry
from league.settings import Storage


def test_leagues(unchanging: TestClient) -> None:
    leagues = {league["league"]: league for league in unchanging.get("/v1/leagues").json()["leagues"]}
    assert list(leagues) == ["board", "duo", "empty", "headless", "memory", "nested", "vector"]
    assert (leagues["board"]["champion"], leagues["board"]["aliases"]) == (1, {"champion": 1})
    assert (leagues["empty"]["champion"], leagues["empty"]["aliases"]) == (None, {})


def test_a_league(unchanging: TestClient) -> None:
    league = unchanging.get("/v1/leagues/duo").json()
    assert (league["league"], league["champion"], league["faults"]) == ("duo", 1, [])
    assert league["agents"] == {"agent_left": "left", "agent_right": "right"}
    assert league["policies"]["left"]["action"]["n"] == 7
    assert unchanging.get("/v1/leagues/empty").json()["replicas"] == []


def test_versions(unchanging: TestClient, storage: Storage) -> None:
    registry = Registry.open(storage)
    versions = unchanging.get("/v1/leagues/board/versions").json()["versions"]
    assert [version["version"] for version in versions] == [1, 2, 3]
    assert [version["aliases"] for version in versions] == [["champion"], [], []]
    assert versions[1]["sha256"] == registry.version("board", 2).sha256
    assert versions[0]["policies"] == ["shared"]
    assert unchanging.get("/v1/leagues/empty/versions").json()["versions"] == []
    registry.close()


@pytest.mark.parametrize("path", ["/v1/leagues/nobody", "/v1/leagues/nobody/versions"])
def test_an_unknown_league(unchanging: TestClient, path: str) -> None:
    reply = unchanging.get(path)
    assert (reply.status_code, reply.json()["code"]) == (404, "unknown_league")
    assert "board" in reply.json()["message"], "it lists the known ones"


def test_a_name_that_no_league_can_have(unchanging: TestClient) -> None:
    reply = unchanging.get("/v1/leagues/NO")
    assert (reply.status_code, reply.json()["code"]) == (400, "invalid_reference")


def test_leagues_are_only_read(unchanging: TestClient) -> None:
    assert unchanging.post("/v1/leagues").json()["code"] == "method_not_allowed"


def test_health(unchanging: TestClient) -> None:
    assert unchanging.get("/v1/health/live").json() == {"status": "live", "replica": "replica-1"}
    assert unchanging.get("/v1/health/ready").json() == {"status": "ready", "replica": "replica-1"}
