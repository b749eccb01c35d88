"""The pages' files: open, sent as they are, and unable to load or run anything of others."""

import re
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from league.registry.registry import Registry
from serve_app.routes.pages import FILES, MEDIA_TYPES

OURS = [path for path in FILES.iterdir() if path.suffix in MEDIA_TYPES]
SCRIPTS = [path for path in OURS if path.suffix == ".js"]


@pytest.mark.parametrize("path", ["/", "/leagues", "/leagues/board", "/leagues/nowhere/verdicts/%3Cb%3E"])
def test_every_page_is_the_same_document(unchanging: TestClient, path: str) -> None:
    reply = unchanging.get(path)
    assert (reply.status_code, reply.headers["content-type"]) == (200, "text/html; charset=utf-8")
    assert reply.text == (FILES / "index.html").read_text()


def test_its_rules_allow_nothing_from_elsewhere(unchanging: TestClient) -> None:
    for path in ("/", "/pages/app.js"):
        headers = unchanging.get(path).headers
        rules = dict(rule.split(" ", 1) for rule in headers["content-security-policy"].split("; "))
        assert rules["default-src"] == rules["base-uri"] == rules["form-action"] == rules["frame-ancestors"] == "'none'"
        assert rules["script-src"] == rules["style-src"] == rules["connect-src"] == "'self'"
        assert rules["img-src"] == "'self' data: blob:"
        assert (headers["x-content-type-options"], headers["referrer-policy"]) == ("nosniff", "no-referrer")


@pytest.mark.parametrize("path", OURS, ids=lambda path: path.name)
def test_a_file_is_sent_as_it_is(unchanging: TestClient, path: Path) -> None:
    for encoding in ("identity", "gzip"):
        reply = unchanging.get(f"/pages/{path.name}", headers={"accept-encoding": encoding})
        assert (reply.status_code, reply.content) == (200, path.read_bytes())
        assert reply.headers["content-type"].startswith(MEDIA_TYPES[path.suffix])
        is_zipped = encoding == "gzip" and path.stat().st_size >= 1024
        assert reply.headers.get("content-encoding") == ("gzip" if is_zipped else None)


def test_a_copy_that_is_the_same_is_not_sent_again(unchanging: TestClient) -> None:
    first = unchanging.get("/pages/app.js")
    assert first.headers["cache-control"] == "no-cache"
    again = unchanging.get("/pages/app.js", headers={"if-none-match": f'W/"other", {first.headers["etag"]}'})
    assert (again.status_code, again.content) == (304, b"")
    assert unchanging.get("/pages/app.js", headers={"if-none-match": 'W/"other"'}).status_code == 200


@pytest.mark.parametrize("file", ["nothing.js", "vendor", "vendor/LICENSE.htm", "../app.py", "..%2Fapp.py", ""])
def test_nothing_else_is_sent(unchanging: TestClient, file: str) -> None:
    reply = unchanging.get(f"/pages/{file}")
    assert (reply.status_code, reply.json()["code"]) == (404, "unknown_path")


def test_they_are_open_where_keys_are_needed(client: TestClient, registry: Registry) -> None:
    registry.create_key("bot", ["read"])
    while client.get("/v1/leagues").status_code != 401:
        pass
    for path in ("/", "/leagues/board", "/pages/app.js"):
        assert client.get(path).status_code == 200
    assert client.post("/leagues/board").status_code == 401


def test_the_document_names_files_that_exist_and_runs_nothing_itself() -> None:
    text = (FILES / "index.html").read_text()
    named = re.findall(r'(?:href|src)="/pages/([^"]+)"', text)
    assert named
    assert all((FILES / name).is_file() for name in named)
    assert not re.findall(r"<style|style=|\son\w+=|<script>", text)


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.name)
def test_scripts_turn_no_text_into_markup_and_import_what_exists(path: Path) -> None:
    text = path.read_text()
    assert not re.findall(
        r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\(|new Function|https?://", text
    )
    for name in re.findall(r'(?:from |import\()"(.+?)"', text):
        assert (path.parent / name).is_file(), name


def test_what_is_vendored_has_its_licence() -> None:
    told = (FILES / "vendor" / "README.md").read_text()
    for path in (FILES / "vendor").iterdir():
        assert path.name == "README.md" or f"`{path.name}`" in told
