"""The page is parsed by an HTML parser instead of searching its text."""

import re
from base64 import b64encode
from collections.abc import Callable, Iterator
from dataclasses import replace
from hashlib import sha256
from html.parser import HTMLParser
from pathlib import Path

import pytest

from evaluation.matches.leaderboard import MAX_UPSETS
from evaluation.reporting import html_page as module
from evaluation.reporting.flipbook import MOST_BYTES, MOST_STEPS
from evaluation.reporting.html_page import render_page, write
from evaluation.reporting.league_report import MOST_VERDICTS, LeagueReport, league_report
from evaluation.results import AnchorReport, Confirmation, Difference
from league.errors import StorageError
from league.refs import short_verdict
from tests.support.leagues import reported_league
from tests.support.leagues.tictactoe import LEAGUE
from tests.support.reports import exploitability_report

BLOCKS = {"td", "th", "li", "p", "dt", "dd", "h3", "b", "caption", "span"}
VOID = {"meta", "link", "img", "input", "br", "hr"}
SECTIONS = ["leaderboard", "versions", "payoff", "verdicts", "promotions", "upsets", "notes"]


class PageParser(HTMLParser):
    """Elements in order as (tag, attributes, text); fails if an element is not closed by its end tag."""

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
        """Attributes and text of each element `tag`, optionally of a class."""
        return [
            (attributes, " ".join("".join(text).split()))
            for name, attributes, text in self.elements
            if name == tag and (not kind or kind in attributes.get("class", "").split())
        ]


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LeagueReport]:
    with reported_league.league_after_nightly(tmp_path_factory.mktemp("home")) as registry:
        yield league_report(registry, LEAGUE)


@pytest.fixture(scope="module")
def page(report: LeagueReport) -> PageParser:
    return PageParser(render_page(report))


def test_each_section_has_a_heading_and_a_link(page: PageParser) -> None:
    assert [attributes["id"] for attributes, _ in page.all("h2")] == SECTIONS
    links = [attributes["href"] for attributes, _ in page.all("a")]
    assert [f"#{name}" for name in SECTIONS] == [link for link in links if link[1:] in SECTIONS]
    ids = {attributes["id"] for _, attributes, _ in page.elements if "id" in attributes}
    assert {link[1:] for link in links} <= ids, "each link has a target"


def test_the_page_has_the_data_of_the_report(report: LeagueReport, page: PageParser) -> None:
    assert page.all("dd")[0][1] == "tictactoe@3"
    rows = [text for _, text in page.all("tr")]
    for standing in report.leaderboard:
        (row,) = [row for row in rows if re.match(rf"\d+ {standing.ref}\b", row)]
        assert f"{standing.score:.3f}" in row
        assert f"{standing.games:,}" in row
    assert len([row for row in rows if "champion" in row and "tictactoe@3" in row]) >= 1
    for verdict, (_, text) in zip(report.verdicts, page.all("article", "verdict"), strict=True):
        assert verdict.reason in text
        assert short_verdict(verdict.verdict) in text
    assert [text for _, text in page.all("h3")].count("tictactoe@3 against tictactoe@2 promoted") == 1


def test_the_heat_map_has_score_and_games_in_each_cell(report: LeagueReport, page: PageParser) -> None:
    assert report.payoff is not None
    played_pairs = [
        (score, games)
        for scores, row in zip(report.payoff.score, report.payoff.games, strict=True)
        for score, games in zip(scores, row, strict=True)
        if score is not None
    ]
    cells = [(a["class"], text) for a, text in page.all("td") if re.fullmatch(r"h\d+", a.get("class", ""))]
    assert len(cells) == len(played_pairs)
    for (kind, text), (score, games) in zip(cells, played_pairs, strict=True):
        assert kind == f"h{round(score * 10)}" or score * 10 % 1 == 0.5
        shown = text.split()
        assert float(shown[0]) == pytest.approx(score, abs=0.0051)
        assert int(shown[1]) == games


def test_games_can_be_viewed_without_a_script(report: LeagueReport, page: PageParser) -> None:
    steps = [step for book in report.upsets for step in book.steps]
    images = page.all("img")
    assert len(images) == len(steps) > 20
    for attributes, _ in images:
        assert attributes["src"].startswith("data:image/png;base64,")
        assert attributes["alt"].startswith("After ")
    items = [text for _, text in page.all("li") if "plays" in text]
    assert len(items) == len(steps) - len(report.upsets), "all steps except the first of each game"
    assert not [a for _, a, _ in page.elements if "hidden" in a]


def test_no_resources_are_loaded(page: PageParser, report: LeagueReport) -> None:
    for tag, attributes, _ in page.elements:
        assert tag not in {"iframe", "object", "embed", "form", "base"}
        for name in ("src", "href", "srcset", "action", "poster", "data", "xlink:href"):
            assert attributes.get(name, "#").startswith(("#", "data:")), (tag, attributes)
    (style,) = [text for _, text in page.all("style")]
    assert "url(" not in style
    assert "@import" not in style
    assert not re.search(r"https?://", render_page(report))


def test_only_its_own_script_and_style_can_run(page: PageParser, report: LeagueReport) -> None:
    rules = next(a["content"] for a, _ in page.all("meta") if a.get("http-equiv") == "Content-Security-Policy")
    parts = dict(rule.strip().split(" ", 1) for rule in rules.split(";"))
    assert parts["default-src"] == "'none'"
    text = render_page(report)
    for tag, rule in (("script", "script-src"), ("style", "style-src")):
        (code,) = re.findall(rf"<{tag}>(.*?)</{tag}>", text, re.S)
        assert parts[rule] == f"'sha256-{b64encode(sha256(code.encode()).digest()).decode()}'"
    for tag, attributes, _ in page.elements:
        assert "style" not in attributes, f"{tag}: forbidden by the content security policy"
        assert not [name for name in attributes if name.startswith("on")]


def test_hostile_text_is_escaped(page: PageParser) -> None:
    assert len(page.all("script")) == 1
    assert not [a for a, _ in page.all("img") if a["src"] == "x"]
    expected = " ".join(reported_league.HOSTILE.split())
    assert [text for _, text in page.all("td")].count(expected) == 2, "actor and reason"


def anchor_report(ref: str, outcome: str) -> AnchorReport:
    return AnchorReport(ref, 30, "s", outcome, -3.0, (-2.9, 2.9), 42, 84, 84, (1, 2, 3, 4, 32), 0.4, 9.0, (1.0, 20.0))


def test_hostile_text_is_escaped_in_all_fields(report: LeagueReport) -> None:
    """In each string of the document, including refs and ids that the registry would reject."""
    hostile = "<script>alert(1)</script>\"'><b onclick=x>"
    verdict = replace(
        report.verdicts[0],
        reason=hostile,
        verdict=hostile,
        model=hostile,
        anchors=(anchor_report(hostile, hostile),),
        candidate=hostile,
    )
    book = replace(
        report.upsets[0],
        match=hostile,
        better=hostile,
        fault=hostile,
        players={hostile: hostile},
        returns={hostile: 1.0},
    )
    text = render_page(
        replace(
            report,
            league=hostile,
            environment=hostile,
            environment_digest=hostile,
            champion=hostile,
            leaderboard=tuple(replace(each, ref=hostile) for each in report.leaderboard),
            by_side={hostile: report.leaderboard},
            versions=tuple(replace(each, ref=hostile) for each in report.versions),
            verdicts=(verdict,),
            upsets=(book,),
            left_out=(hostile,),
        )
    )
    page = PageParser(text)
    assert len(page.all("script")) == 1
    assert not page.all("b", "onclick")
    assert not [a for _, a, _ in page.elements if "onclick" in a]


def test_the_leaderboard_shows_roles(report: LeagueReport) -> None:
    page = PageParser(render_page(replace(report, roles={"tictactoe@1": "exploiter of tictactoe@3"})))
    assert "tictactoe@1 exploiter of tictactoe@3" in [text for _, text in page.all("th")]


def test_tables_have_headings_and_captions_and_charts_have_labels(page: PageParser) -> None:
    assert len(page.all("table")) == len(page.all("caption"))
    assert all(a.get("scope") in ("row", "col") for a, _ in page.all("th"))
    for attributes, _ in page.all("svg"):
        assert attributes.get("aria-hidden") == "true" or len(attributes["aria-label"]) > 30
    assert [a["lang"] for a, _ in page.all("html")] == ["en"]


def test_the_size_of_a_page_with_a_thousand_versions_is_limited(report: LeagueReport) -> None:
    book = report.upsets[0]
    image = "data:" + "A" * (MOST_BYTES // MAX_UPSETS // MOST_STEPS)
    large = replace(
        report,
        leaderboard=report.leaderboard * 200,
        versions=tuple(replace(report.versions[0], number=number) for number in range(1, 1001)),
        verdicts=(replace(report.verdicts[0], curve=(0.1, -0.1) * 2000),) * MOST_VERDICTS,
        promotions=report.promotions * 250,
        upsets=(replace(book, steps=(replace(book.steps[0], picture=image),) * MOST_STEPS),) * MAX_UPSETS,
    )
    assert 3_000_000 < len(render_page(large).encode()) < 5_000_000


def test_optional_fields_of_a_verdict_are_shown(report: LeagueReport) -> None:
    verdict = replace(
        report.verdicts[0],
        alpha=0.05 / 365,
        anchors=(anchor_report("script:one_ply", "inferior"),),
        confirmation=Confirmation("v", "l@2", "l@1", 400, 0.544, 31.0, (4.0, 59.0), Difference(1.5, 0.5, 2.5)),
        interval=(None, 70.0),
    )
    (_, text), *_ = PageParser(render_page(replace(report, verdicts=(verdict,)))).all("article", "verdict")
    assert "spends α = 0.00014" in text
    assert "script:one_ply inferior 30 0.400 – −3 [−2.9, +2.9] 84" in text
    assert "Confirmation match: +31 Elo [+4, +59], score 0.544, 400 games, returns differ by +1.5 [" in text
    assert "[−∞, +70]" in text


@pytest.mark.parametrize(
    ("model", "outcome", "expected"),
    [
        ("normalized", "more exploitable", "more exploitable than tictactoe@2 by 0.1 of all points"),
        ("returns", "more exploitable", "more exploitable than tictactoe@2 by 0.1 in returns"),
        ("normalized", "less exploitable", "less exploitable than tictactoe@2"),
        ("normalized", "inconclusive", "inconclusive compared with tictactoe@2"),
        ("normalized", "open", "open compared with tictactoe@2"),
    ],
)
@pytest.mark.parametrize("exploiters", [1, 2])
def test_exploitability_is_compared(
    report: LeagueReport, model: str, outcome: str, expected: str, exploiters: int
) -> None:
    test = exploitability_report(outcome, exploiters, improvement=0.05 if outcome == "less exploitable" else 0.0)
    verdict = replace(report.verdicts[0], candidate="tictactoe@3", model=model, exploitability=test)
    (_, text), *_ = PageParser(render_page(replace(report, verdicts=(verdict,)))).all("article", "verdict")
    assert f"tictactoe@3: {expected} after 600 games, LLR −3 of [−2.9, +2.9]." in text
    assert "tictactoe@3 tictactoe@4 400 0.600 [0.500, 0.700] +0.25 [+0.125, +0.375]" in text
    assert "A best response to tictactoe@2 scores at least 0.400." in text
    with_others = "; +0.1 [+0.01, +0.19] with an interval for others that are trained in the same way"
    of_others = with_others if exploiters > 1 else ""
    assert f"more than those of the champion, with an interval for these exploiters{of_others}." in text


@pytest.mark.parametrize("league", [reported_league.empty, reported_league.league_with_roles])
def test_each_kind_of_league_has_a_page(league: Callable[..., object], tmp_path: Path) -> None:
    with league(tmp_path) as registry:  # type: ignore[attr-defined]
        report = league_report(registry, LEAGUE)
    page = PageParser(render_page(report))
    assert [attributes["id"] for attributes, _ in page.all("h2")] == SECTIONS
    headings = [text for _, text in page.all("h3")]
    assert ("As adversary" in headings) == ("As good" in headings) == bool(report.by_side)
    if not report.games:
        assert [text for _, text in page.all("p") if text.startswith("No games yet.")]


def test_long_tables_are_truncated_with_a_note(report: LeagueReport, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_ROWS", 2)
    page = PageParser(render_page(report))
    assert "Only the best 2 of 5 contestants are listed; --json contains all." in [text for _, text in page.all("li")]
    assert len([text for _, text in page.all("tr") if re.match(r"\d (script|tictactoe)", text)]) == 2


def test_the_page_is_written_atomically(report: LeagueReport, tmp_path: Path) -> None:
    out = tmp_path / "report.html"
    write(report, out)
    assert out.read_text(encoding="utf-8") == render_page(report)
    assert list(tmp_path.iterdir()) == [out]
    with pytest.raises(StorageError, match="nowhere"):
        write(report, tmp_path / "nowhere" / "report.html")
