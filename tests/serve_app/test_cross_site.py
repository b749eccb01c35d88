"""Pages of other sites change nothing here, even where nobody needs a key; programs and our own pages are let in."""

import pytest
from starlette.testclient import TestClient

from serve_app.cross_site import refuse_cross_site
from serve_app.error_handlers import CrossSite
from tests.serve_app.test_action import BOARD

ACTION = "/v1/policies/board/action"
BODY = {"observation": BOARD}
HOST = "127.0.0.1:8000"

OURS = [
    {},
    {"sec-fetch-site": "same-origin", "origin": f"http://{HOST}"},
    {"sec-fetch-site": "same-origin", "origin": "https://what.a.proxy.calls.itself"},
    {"sec-fetch-site": "none"},
    {"origin": f"http://{HOST}"},
    {"origin": f"https://{HOST}"},
]
THEIRS = [
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


def shown(headers: dict[str, str]) -> list[tuple[bytes, bytes]]:
    return [(name.encode(), value.encode()) for name, value in (headers | {"host": HOST}).items()]


@pytest.mark.parametrize("headers", OURS, ids=str)
def test_our_pages_and_programs_are_let_in(headers: dict[str, str]) -> None:
    refuse_cross_site("POST", shown(headers))


@pytest.mark.parametrize("headers", THEIRS, ids=str)
def test_other_pages_only_look(headers: dict[str, str]) -> None:
    for method in ("POST", "DELETE", "PUT", "OPTIONS"):
        with pytest.raises(CrossSite):
            refuse_cross_site(method, shown(headers))
    for method in ("GET", "HEAD"):
        refuse_cross_site(method, shown(headers))


@pytest.mark.parametrize("path", [ACTION, "/v1/leagues/board/rollback", "/v1/leagues/board/evaluations", "/docs"])
def test_every_way_in_refuses_them(unchanging: TestClient, path: str) -> None:
    reply = unchanging.post(path, json=BODY, headers={"origin": "https://evil.example"})
    assert (reply.status_code, reply.json()["code"]) == (403, "cross_site")
    assert "https://evil.example" in reply.json()["message"]


def test_the_open_inference_protocol_says_it_in_its_own_form(unchanging: TestClient) -> None:
    reply = unchanging.post("/v2/models/board/infer", json={}, headers={"sec-fetch-site": "cross-site"})
    assert (reply.status_code, list(reply.json())) == (403, ["error"])


def test_a_page_of_ours_acts_and_another_may_look(unchanging: TestClient) -> None:
    ours, theirs = {"origin": "http://testserver"}, {"origin": "https://evil.example", "sec-fetch-site": "cross-site"}
    assert unchanging.post(ACTION, json=BODY, headers=ours).status_code == 200
    assert unchanging.get("/v1/leagues", headers=theirs).status_code == 200
