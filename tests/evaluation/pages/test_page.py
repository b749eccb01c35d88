"""The page is read as a browser would read it: by an HTML parser, never by searching its text for markup."""

import re
from base64 import b64encode
from collections.abc import Callable, Iterator
from dataclasses import replace
from hashlib import sha256
from html.parser import HTMLParser
from pathlib import Path

import pytest

from evaluation.pages import page as module
from evaluation.pages.flipbook import MOST_BYTES, MOST_STEPS
from evaluation.pages.league_report import MOST_SURPRISES, MOST_VERDICTS, LeagueReport, league_report
from evaluation.pages.page import page, write
from evaluation.report import AnchorReport, Confirmation, Difference
from league.errors import StorageError
from tests.evaluation.examples import LEAGUE
from tests.evaluation.pages import leagues

BLOCKS = {"td", "th", "li", "p", "dt", "dd", "h3", "b", "caption", "span"}
VOID = {"meta", "link", "img", "input", "br", "hr"}
SECTIONS = ["standings", "versions", "payoff", "verdicts", "promotions", "surprises", "notes"]


class Reader(HTMLParser):
    """Elements in their order as (tag, attributes, text), and a check that each is closed by its own end tag."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str], list[str]]] = []
        self._open: list[tuple[str, list[str]]] = []
        self.feed(text)
        self.close()
        assert not self._open, f"never closed: {self._open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        names = [name for name, _ in attrs]
        assert len(names) == len(set(names)), f"{tag} has an attribute twice"
        text: list[str] = []
        self.elements.append((tag, {name: value or "" for name, value in attrs}, text))
        if tag not in VOID:
            self._open.append((tag, text))

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.handle_endtag(tag)

    def handle_endtag(self, tag: str) -> None:
        opened, _ = self._open.pop()
        assert opened == tag, f"</{tag}> closes <{opened}>"
        if tag in BLOCKS:
            self.handle_data(" ")

    def handle_data(self, data: str) -> None:
        for _, text in self._open:
            text.append(data)

    def all(self, tag: str, kind: str = "") -> list[tuple[dict[str, str], str]]:
        """Attributes and text of each element `tag`, or of those of a class."""
        return [
            (attributes, " ".join("".join(text).split()))
            for name, attributes, text in self.elements
            if name == tag and (not kind or kind in attributes.get("class", "").split())
        ]


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LeagueReport]:
    with leagues.of_a_night(tmp_path_factory.mktemp("home")) as registry:
        yield league_report(registry, LEAGUE)


@pytest.fixture(scope="module")
def read(report: LeagueReport) -> Reader:
    return Reader(page(report))


def test_every_section_is_there_under_a_heading_and_in_the_contents(read: Reader) -> None:
    assert [attributes["id"] for attributes, _ in read.all("h2")] == SECTIONS
    links = [attributes["href"] for attributes, _ in read.all("a")]
    assert [f"#{name}" for name in SECTIONS] == [link for link in links if link[1:] in SECTIONS]
    ids = {attributes["id"] for _, attributes, _ in read.elements if "id" in attributes}
    assert {link[1:] for link in links} <= ids, "each link leads somewhere"


def test_it_tells_what_the_document_does(report: LeagueReport, read: Reader) -> None:
    assert read.all("dd")[0][1] == "tictactoe@3"
    rows = [text for _, text in read.all("tr")]
    for standing in report.standings:
        (row,) = [row for row in rows if re.match(rf"\d+ {standing.ref}\b", row)]
        assert f"{standing.score:.3f}" in row
        assert f"{standing.games:,}" in row
    assert len([row for row in rows if "champion" in row and "tictactoe@3" in row]) >= 1
    for verdict, (_, text) in zip(report.verdicts, read.all("article", "verdict"), strict=True):
        assert verdict.reason in text
        assert verdict.verdict in text
    assert [text for _, text in read.all("h3")].count("tictactoe@3 against tictactoe@2 promoted") == 1


def test_the_heat_map_has_score_and_games_in_each_cell(report: LeagueReport, read: Reader) -> None:
    assert report.payoff is not None
    met = [
        (score, games)
        for scores, row in zip(report.payoff.score, report.payoff.games, strict=True)
        for score, games in zip(scores, row, strict=True)
        if score is not None
    ]
    cells = [(a["class"], text) for a, text in read.all("td") if re.fullmatch(r"h\d+", a.get("class", ""))]
    assert len(cells) == len(met)
    for (kind, text), (score, games) in zip(cells, met, strict=True):
        assert kind == f"h{round(score * 10)}" or score * 10 % 1 == 0.5
        shown = text.split()
        assert float(shown[0]) == pytest.approx(score, abs=0.0051)
        assert int(shown[1]) == games


def test_games_can_be_looked_at_without_a_script(report: LeagueReport, read: Reader) -> None:
    steps = [step for book in report.surprises for step in book.steps]
    pictures = read.all("img")
    assert len(pictures) == len(steps) > 20
    for attributes, _ in pictures:
        assert attributes["src"].startswith("data:image/png;base64,")
        assert attributes["alt"].startswith("After ")
    told = [text for _, text in read.all("li") if "plays" in text]
    assert len(told) == len(steps) - len(report.surprises), "all but the beginnings"
    assert not [a for _, a, _ in read.elements if "hidden" in a]


def test_nothing_is_loaded_from_elsewhere(read: Reader, report: LeagueReport) -> None:
    for tag, attributes, _ in read.elements:
        assert tag not in {"iframe", "object", "embed", "form", "base"}
        for name in ("src", "href", "srcset", "action", "poster", "data", "xlink:href"):
            assert attributes.get(name, "#").startswith(("#", "data:")), (tag, attributes)
    (style,) = [text for _, text in read.all("style")]
    assert "url(" not in style
    assert "@import" not in style
    assert not re.search(r"https?://", page(report))


def test_only_its_own_script_and_style_may_run(read: Reader, report: LeagueReport) -> None:
    rules = next(a["content"] for a, _ in read.all("meta") if a.get("http-equiv") == "Content-Security-Policy")
    parts = dict(rule.strip().split(" ", 1) for rule in rules.split(";"))
    assert parts["default-src"] == "'none'"
    text = page(report)
    for tag, rule in (("script", "script-src"), ("style", "style-src")):
        (code,) = re.findall(rf"<{tag}>(.*?)</{tag}>", text, re.S)
        assert parts[rule] == f"'sha256-{b64encode(sha256(code.encode()).digest()).decode()}'"
    for tag, attributes, _ in read.elements:
        assert "style" not in attributes, f"{tag}: the policy forbids it"
        assert not [name for name in attributes if name.startswith("on")]


def test_hostile_text_is_text(read: Reader) -> None:
    assert len(read.all("script")) == 1
    assert not [a for a, _ in read.all("img") if a["src"] == "x"]
    shown = " ".join(leagues.HOSTILE.split())
    assert [text for _, text in read.all("td")].count(shown) == 2, "who, and why"


def anchored(ref: str, outcome: str) -> AnchorReport:
    return AnchorReport(ref, 30, "s", outcome, -3.0, (-2.9, 2.9), 42, 84, 84, (1, 2, 3, 4, 32), 0.4, 9.0, (1.0, 20.0))


def test_hostile_text_is_text_wherever_it_stands(report: LeagueReport) -> None:
    """In every string of the document, refs and ids included, which the registry itself would refuse."""
    bad = "<script>alert(1)</script>\"'><b onclick=x>"
    verdict = replace(
        report.verdicts[0], reason=bad, verdict=bad, model=bad, anchors=(anchored(bad, bad),), candidate=bad
    )
    book = replace(report.surprises[0], match=bad, better=bad, fault=bad, cast={bad: bad}, returns={bad: 1.0})
    text = page(
        replace(
            report,
            league=bad,
            environment=bad,
            environment_digest=bad,
            champion=bad,
            standings=tuple(replace(each, ref=bad) for each in report.standings),
            by_side={bad: report.standings},
            versions=tuple(replace(each, ref=bad) for each in report.versions),
            verdicts=(verdict,),
            surprises=(book,),
            left_out=(bad,),
        )
    )
    read = Reader(text)
    assert len(read.all("script")) == 1
    assert not read.all("b", "onclick")
    assert not [a for _, a, _ in read.elements if "onclick" in a]


def test_tables_have_headings_and_captions_and_charts_say_what_they_show(read: Reader) -> None:
    assert len(read.all("table")) == len(read.all("caption"))
    assert all(a.get("scope") in ("row", "col") for a, _ in read.all("th"))
    for attributes, _ in read.all("svg"):
        assert attributes.get("aria-hidden") == "true" or len(attributes["aria-label"]) > 30
    assert [a["lang"] for a, _ in read.all("html")] == ["en"]


def test_a_league_of_a_thousand_versions_is_no_larger_than_it_may_be(report: LeagueReport) -> None:
    book = report.surprises[0]
    picture = "data:" + "A" * (MOST_BYTES // MOST_SURPRISES // MOST_STEPS)
    large = replace(
        report,
        standings=report.standings * 200,
        versions=tuple(replace(report.versions[0], number=number) for number in range(1, 1001)),
        verdicts=(replace(report.verdicts[0], curve=(0.1, -0.1) * 2000),) * MOST_VERDICTS,
        promotions=report.promotions * 250,
        surprises=(replace(book, steps=(replace(book.steps[0], picture=picture),) * MOST_STEPS),) * MOST_SURPRISES,
    )
    assert 3_000_000 < len(page(large).encode()) < 5_000_000


def test_what_else_a_verdict_has_is_shown(report: LeagueReport) -> None:
    verdict = replace(
        report.verdicts[0],
        alpha=0.05 / 365,
        anchors=(anchored("script:one_ply", "inferior"),),
        confirmation=Confirmation("v", "l@2", "l@1", 400, 0.544, 31.0, (4.0, 59.0), Difference(1.5, 0.5, 2.5)),
        interval=(None, 70.0),
    )
    (_, text), *_ = Reader(page(replace(report, verdicts=(verdict,)))).all("article", "verdict")
    assert "spends α = 0.00014" in text
    assert "script:one_ply inferior 30 −3 [−2.9, +2.9] 84" in text
    assert "Confirmed by fresh games: +31 Elo [+4, +59], score 0.544, 400 games, returns differ by +1.5 [" in text
    assert "[−∞, +70]" in text


@pytest.mark.parametrize("league", [leagues.empty, leagues.of_unlike_sides])
def test_every_kind_of_league_has_a_page(league: Callable[..., object], tmp_path: Path) -> None:
    with league(tmp_path) as registry:  # type: ignore[attr-defined]
        report = league_report(registry, LEAGUE)
    read = Reader(page(report))
    assert [attributes["id"] for attributes, _ in read.all("h2")] == SECTIONS
    headings = [text for _, text in read.all("h3")]
    assert ("As adversary" in headings) == ("As good" in headings) == bool(report.by_side)
    if not report.games:
        assert [text for _, text in read.all("p") if text.startswith("Nobody has played yet.")]


def test_long_tables_are_cut_and_it_is_said(report: LeagueReport, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_ROWS", 2)
    read = Reader(page(report))
    assert "Of 5 contestants the best 2 are listed; --json has all." in [text for _, text in read.all("li")]
    assert len([text for _, text in read.all("tr") if re.match(r"\d (script|tictactoe)", text)]) == 2


def test_it_is_written_whole_or_not_at_all(report: LeagueReport, tmp_path: Path) -> None:
    out = tmp_path / "report.html"
    write(report, out)
    assert out.read_text(encoding="utf-8") == page(report)
    assert list(tmp_path.iterdir()) == [out]
    with pytest.raises(StorageError, match="nowhere"):
        write(report, tmp_path / "nowhere" / "report.html")
