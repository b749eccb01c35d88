"""A report is one file with all pages, in which no text can run. An HTML parser reads it, as a browser would."""

import json
import re
from base64 import b64decode
from html.parser import HTMLParser

from policy_league.cli.evaluation.report_contents import report_file
from serve_app.routes.pages import FILES

HOSTILE = "</script><script>alert('mine')</script><!-- <script> <img src=x onerror=alert(1)> \u2028 '\"&"
REPORT = {"league": HOSTILE, "made_at": HOSTILE, "documents": {HOSTILE: {HOSTILE: [HOSTILE, 1.5, None]}}}


class Elements(HTMLParser):
    """Elements in order as [tag, attributes, text], the text of scripts and styles only."""

    def __init__(self, document: bytes) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None], list[str]]] = []
        self.feed(document.decode())
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs), []))

    def handle_data(self, data: str) -> None:
        if self.found:
            self.found[-1][2].append(data)

    def all(self, tag: str, **attributes: str) -> list[tuple[dict[str, str | None], str]]:
        return [
            (attrs, "".join(text))
            for name, attrs, text in self.found
            if name == tag and attributes.items() <= attrs.items()
        ]


def test_hostile_text_is_data_in_the_file() -> None:
    elements = Elements(report_file(REPORT))
    ((_, data),) = elements.all("script", id="report")
    assert json.loads(data) == REPORT
    assert len(elements.all("script")) == 4, "theme, import map, data and the start of the pages"
    assert not elements.all("img", src="x")


def test_only_its_own_scripts_and_styles_can_run() -> None:
    elements = Elements(report_file(REPORT))
    ((attributes, _),) = elements.all("meta", **{"http-equiv": "Content-Security-Policy"})
    rules = dict(rule.split(" ", 1) for rule in (attributes["content"] or "").split("; "))
    assert rules["default-src"] == rules["base-uri"] == rules["form-action"] == "'none'"
    assert rules["img-src"] == "data:"
    assert rules["script-src"] == rules["style-src"]
    (nonce,) = re.findall(r"^'nonce-([\w-]{40,})'$", rules["script-src"])
    code = [attrs for tag, attrs, _ in elements.found if tag in ("script", "style") and attrs.get("id") != "report"]
    assert len(code) > 5
    assert {attrs["nonce"] for attrs in code} == {nonce}
    assert report_file(REPORT).count(nonce.encode()) == 0, "every file has its own"


def test_the_file_refers_to_nothing_else() -> None:
    for tag, attributes, _ in Elements(report_file(REPORT)).found:
        assert tag not in {"iframe", "object", "embed", "form", "base"}
        for name in ("src", "href", "srcset", "action"):
            assert (attributes.get(name) or "#").startswith(("data:", "#")) or (tag, attributes.get(name)) == ("a", "/")


def test_the_import_map_contains_all_modules_with_names_that_it_maps() -> None:
    ((_, text),) = Elements(report_file(REPORT)).all("script", type="importmap")
    imports = json.loads(text)["imports"]
    assert imports.keys() == {path.relative_to(FILES).as_posix() for path in FILES.rglob("*.js")}
    for name, url in imports.items():
        kind, _, data = url.partition(";base64,")
        assert kind == "data:text/javascript"
        code = b64decode(data).decode()
        assert code.replace('"./', '"') == (FILES / name).read_text().replace('"./', '"')
        assert set(re.findall(r'(?:from |import\()"(.+?)"', code)) <= imports.keys(), name
