"""Pages of other sites cannot change anything, even if no key is required; programs and our own pages can."""

import pytest
from starlette.testclient import TestClient

from serve_app.access.access_control import reject_cross_site
from serve_app.access.errors import CrossSiteRequest
from tests.support.clients.actions import BOARD

ACTION = "/v1/policies/board/action"
BODY = {"observation": BOARD}
HOST = "127.0.0.1:8000"

SAME_SITE = [
    {},
    {"sec-fetch-site": "same-origin", "origin": f"http://{HOST}"},
    {"sec-fetch-site": "same-origin", "origin": "https://what.a.proxy.calls.itself"},
    {"sec-fetch-site": "none"},
    {"origin": f"http://{HOST}"},
    {"origin": f"https://{HOST}"},
]
CROSS_SITE = [
    {"sec-fetch-site": "cross-site", "origin": "https://evil.example"},
    {"sec-fetch-site": "cross-site"},
    {"sec-fetch-site": "same-site", "origin": "http://127.0.0.1:3000"},
    {"sec-fetch-site": "", "origin": f"http://{HOST}"},
    {"sec-fetch-site": "cross-site", "origin": f"http://{HOST}"},
    {"origin": "https://evil.example"},
    {"origin": "http://127.0.0.1:3000"},
    {"origin": f"http://{HOST}.evil.example"},
    {"origin": f"http://evil.example/{HOST}"},
    {"origin": "null"},
    {"origin": ""},
]


def encoded(headers: dict[str, str]) -> list[tuple[bytes, bytes]]:
    return [(name.encode(), value.encode()) for name, value in (headers | {"host": HOST}).items()]


@pytest.mark.parametrize("headers", SAME_SITE, ids=str)
def test_our_pages_and_programs_are_accepted(headers: dict[str, str]) -> None:
    reject_cross_site("POST", encoded(headers))


@pytest.mark.parametrize("headers", CROSS_SITE, ids=str)
def test_other_pages_can_only_read(headers: dict[str, str]) -> None:
    for method in ("POST", "DELETE", "PUT", "OPTIONS"):
        with pytest.raises(CrossSiteRequest):
            reject_cross_site(method, encoded(headers))
    for method in ("GET", "HEAD"):
        reject_cross_site(method, encoded(headers))


@pytest.mark.parametrize("path", [ACTION, "/v1/leagues/board/rollback", "/v1/leagues/board/evaluations", "/docs"])
def test_each_route_rejects_cross_site_changes(read_only_client: TestClient, path: str) -> None:
    reply = read_only_client.post(path, json=BODY, headers={"origin": "https://evil.example"})
    assert (reply.status_code, reply.json()["code"]) == (403, "cross_site")
    assert "https://evil.example" in reply.json()["message"]


def test_the_open_inference_protocol_has_its_own_error_format(read_only_client: TestClient) -> None:
    reply = read_only_client.post("/v2/models/board/infer", json={}, headers={"sec-fetch-site": "cross-site"})
    assert (reply.status_code, list(reply.json())) == (403, ["error"])


def test_our_page_can_act_and_another_can_read(read_only_client: TestClient) -> None:
    same_site, cross_site = (
        {"origin": "http://testserver"},
        {"origin": "https://evil.example", "sec-fetch-site": "cross-site"},
    )
    assert read_only_client.post(ACTION, json=BODY, headers=same_site).status_code == 200
    assert read_only_client.get("/v1/leagues", headers=cross_site).status_code == 200
