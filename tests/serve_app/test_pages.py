"""The files of the web pages: public, unmodified, and restricted to their own resources."""

import hashlib
import re
from pathlib import Path
from urllib.parse import urljoin

import pytest
from starlette.testclient import TestClient

from league.registry.registry import Registry
from serve_app.routes.pages import FILES, MEDIA_TYPES
from tests.support.waiting import until

PAGE_FILES = [path for path in FILES.iterdir() if path.suffix in MEDIA_TYPES]
SCRIPTS = [path for path in PAGE_FILES if path.suffix == ".js"]


@pytest.mark.parametrize(
    "path",
    [
        "/",
        "/leagues",
        "/leagues/",
        "/leagues/board",
        "/leagues/nowhere/verdicts/%3Cb%3E",
        "/leagues/a%2F..%2Fb",
        "/leagues/b/matches/s/0/1",
    ],
)
@pytest.mark.parametrize("prefix", ["", "/ai", "/very/long"])
def test_all_pages_are_the_same_document_whose_references_hold_below_any_prefix(
    read_only_client: TestClient, path: str, prefix: str
) -> None:
    reply = read_only_client.get(path)  # as a proxy sends it that has removed the prefix
    assert (reply.status_code, reply.headers["content-type"]) == (200, "text/html; charset=utf-8")
    document = (FILES / "index.html").read_text()
    shown = re.sub(
        r'(?<=href="|.src=")[^"]+', lambda found: urljoin(f"http://host{prefix}{path}", found[0]), reply.text
    )
    assert shown == re.sub(r'(?<=href="|.src=")/', f"http://host{prefix}/", document)


def test_a_path_with_too_many_slashes_is_no_page(read_only_client: TestClient) -> None:
    assert read_only_client.get("/leagues" + "/a" * 20).status_code == 404


@pytest.mark.parametrize(("path", "target"), [("/docs/", "/docs"), ("/v1/leagues/?limit=1", "/v1/leagues?limit=1")])
def test_redirects_are_relative(read_only_client: TestClient, path: str, target: str) -> None:
    reply = read_only_client.get(path, follow_redirects=False)
    assert reply.status_code == 307
    assert urljoin(f"https://host/ai{path}", reply.headers["location"]) == f"https://host/ai{target}"
    assert read_only_client.get(path).status_code == 200
    assert read_only_client.get("/nothing/").status_code == 404


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
