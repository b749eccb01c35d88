"""The files of the web pages: public, unmodified, and restricted to their own resources."""

import hashlib
import re
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from league.registry.registry import Registry
from serve_app.routes.pages import FILES, MEDIA_TYPES
from tests.support.waiting import until

PAGE_FILES = [path for path in FILES.iterdir() if path.suffix in MEDIA_TYPES]
SCRIPTS = [path for path in PAGE_FILES if path.suffix == ".js"]


@pytest.mark.parametrize("path", ["/", "/leagues", "/leagues/board", "/leagues/nowhere/verdicts/%3Cb%3E"])
def test_all_pages_are_the_same_document(read_only_client: TestClient, path: str) -> None:
    reply = read_only_client.get(path)
    assert (reply.status_code, reply.headers["content-type"]) == (200, "text/html; charset=utf-8")
    assert reply.text == (FILES / "index.html").read_text()


def test_the_content_security_policy_allows_own_resources_only(read_only_client: TestClient) -> None:
    for path in ("/", "/pages/app.js"):
        headers = read_only_client.get(path).headers
        rules = dict(rule.split(" ", 1) for rule in headers["content-security-policy"].split("; "))
        assert rules["default-src"] == rules["base-uri"] == rules["form-action"] == rules["frame-ancestors"] == "'none'"
        assert rules["script-src"] == rules["style-src"] == rules["connect-src"] == "'self'"
        assert rules["img-src"] == "'self' data: blob:"
        assert (headers["x-content-type-options"], headers["referrer-policy"]) == ("nosniff", "no-referrer")


@pytest.mark.parametrize("path", PAGE_FILES, ids=lambda path: path.name)
def test_a_file_is_sent_unmodified(read_only_client: TestClient, path: Path) -> None:
    for encoding in ("identity", "gzip"):
        reply = read_only_client.get(f"/pages/{path.name}", headers={"accept-encoding": encoding})
        assert (reply.status_code, reply.content) == (200, path.read_bytes())
        assert reply.headers["content-type"].startswith(MEDIA_TYPES[path.suffix])
        is_zipped = encoding == "gzip" and path.stat().st_size >= 1024
        assert reply.headers.get("content-encoding") == ("gzip" if is_zipped else None)


def test_an_unmodified_file_is_not_sent_again(read_only_client: TestClient) -> None:
    first = read_only_client.get("/pages/app.js")
    assert first.headers["cache-control"] == "no-cache"
    second = read_only_client.get("/pages/app.js", headers={"if-none-match": f'W/"other", {first.headers["etag"]}'})
    assert (second.status_code, second.content) == (304, b"")
    assert read_only_client.get("/pages/app.js", headers={"if-none-match": 'W/"other"'}).status_code == 200


@pytest.mark.parametrize("file", ["nothing.js", "vendor", "vendor/LICENSE.htm", "../app.py", "..%2Fapp.py", ""])
def test_no_other_files_are_sent(read_only_client: TestClient, file: str) -> None:
    reply = read_only_client.get(f"/pages/{file}")
    assert (reply.status_code, reply.json()["code"]) == (404, "unknown_path")


def test_pages_need_no_key(client: TestClient, registry: Registry) -> None:
    registry.keys.create("bot", ["read"])
    until(lambda: client.get("/v1/leagues").status_code == 401)
    for path in ("/", "/leagues/board", "/pages/app.js"):
        assert client.get(path).status_code == 200
    assert client.post("/leagues/board").status_code == 401


def test_the_document_refers_to_existing_files_and_has_no_inline_code() -> None:
    text = (FILES / "index.html").read_text()
    files = re.findall(r'(?:href|src)="/pages/([^"]+)"', text)
    assert files
    assert all((FILES / name).is_file() for name in files)
    assert not re.findall(r"<style|style=|\son\w+=|<script>", text)


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.name)
def test_scripts_insert_no_html_and_import_existing_files(path: Path) -> None:
    text = path.read_text()
    assert not re.findall(
        r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\(|new Function|https?://", text
    )
    for name in re.findall(r'(?:from |import\()"(.+?)"', text):
        assert (path.parent / name).is_file(), name


def test_charts_name_their_axes() -> None:
    charts = [chart for path in SCRIPTS for chart in re.findall(r"<\$\{Chart\} (.+?)/>", path.read_text(), re.DOTALL)]
    assert charts
    assert [chart for chart in charts if "xName=" not in chart or "yName=" not in chart] == []


def test_vendored_files_have_their_licence() -> None:
    readme = (FILES / "vendor" / "README.md").read_text()
    for path in (FILES / "vendor").iterdir():
        assert path.name == "README.md" or f"`{path.name}`" in readme


def test_vendored_files_are_those_of_their_packages() -> None:
    vendor = FILES / "vendor"
    recorded = dict(re.findall(r"^([0-9a-f]{64})  (\S+)$", (vendor / "README.md").read_text(), re.MULTILINE))
    assert {hashlib.sha256(path.read_bytes()).hexdigest(): path.name for path in vendor.glob("*.*s")} == recorded
