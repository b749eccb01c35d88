"""A report: its documents, what programs get of them, and one file with all pages, in which no text can run."""

import base64
import json
import re
from base64 import b64decode
from collections.abc import Iterator
from html.parser import HTMLParser
from io import BytesIO
from pathlib import Path
from threading import Event, Thread
from typing import Any
from unittest import mock

import pytest
from jsonschema import Draft202012Validator
from PIL import Image

from evaluation.gating.nightly import nightly
from evaluation.gating.verdicts import open_verdict
from evaluation.service import game_worker
from league import service_requests
from league.errors import EnvironmentMismatch, UnknownLeague
from league.registry.registry import Registry
from league.results.ledger import Ledger
from policy_league.cli.evaluation import report_contents as module
from policy_league.cli.evaluation.report_contents import league_report, plain_document, report_file
from serve_app.openapi.document import document
from serve_app.routes.pages import FILES
from tests.support.leagues import reported_league, tictactoe
from tests.support.leagues.tictactoe import LEAGUE
from tests.support.servers.replicas import QUICK

BASE = f"/v1/leagues/{LEAGUE}"


SCHEMAS = {
    BASE: "League",
    f"{BASE}/leaderboard": "Leaderboard",
    f"{BASE}/payoff": "PayoffTable",
    f"{BASE}/ratings": "Ratings",
    f"{BASE}/versions": "Versions",
    f"{BASE}/verdicts": "Verdicts",
    f"{BASE}/aliases/champion/history": "History",
}
"""Schema of each document that every report has."""


@pytest.fixture(scope="module")
def registry(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Registry]:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("evaluation.matches.leaderboard.MAX_UPSETS", 2)  # each report replays and draws them
        with reported_league.league_after_nightly(tmp_path_factory.mktemp("home")) as opened:
            yield opened


@pytest.fixture(scope="module")
def report(registry: Registry) -> dict[str, Any]:
    return league_report(registry, LEAGUE)


@pytest.fixture(scope="module")
def plain(report: dict[str, Any]) -> dict[str, Any]:
    return plain_document(report)


def recordings(report: dict[str, Any]) -> list[dict[str, Any]]:
    """The recorded games of a report."""
    return [content for path, content in report["documents"].items() if "/games/" in path]


def images(recording: dict[str, Any]) -> list[bytes]:
    kind, data = zip(*(step["picture"].split(",") for step in recording["steps"]), strict=True)
    assert set(kind) == {"data:image/png;base64"}
    return [Image.open(BytesIO(base64.b64decode(image))).convert("RGB").tobytes() for image in data]


def test_documents_have_the_shape_of_the_api(report: dict[str, Any]) -> None:
    schemas = {"components": document(QUICK, [])["components"]}
    for path, schema in SCHEMAS.items():
        Draft202012Validator({"$ref": f"#/components/schemas/{schema}"} | schemas).validate(report["documents"][path])
    for path, content in report["documents"].items():
        if path.startswith(f"{BASE}/verdicts/"):
            Draft202012Validator({"$ref": "#/components/schemas/Verdict"} | schemas).validate(content)
            assert content["curve"], path
    assert SCHEMAS.keys() < report["documents"].keys()


def test_lists_are_whole(registry: Registry, report: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_PAGE", 2)
    paged = league_report(registry, LEAGUE)
    assert paged["documents"] == report["documents"]
    leaderboard = paged["documents"][f"{BASE}/leaderboard"]
    assert [row["rank"] for row in leaderboard["leaderboard"]] == [1, 2, 3, 4, 5]
    versions = paged["documents"][f"{BASE}/versions"]
    assert ([version["version"] for version in versions["versions"]], versions["next"]) == ([3, 2, 1], None)


def test_the_plain_document_has_all_results(registry: Registry, report: dict[str, Any], plain: dict[str, Any]) -> None:
    """Without what only a running server has."""
    documents = report["documents"]
    about = documents[BASE]
    assert (about["replicas"], about["faults"], about["summary"]["earlier"]) == ([], [], [])
    assert (about["traffic"]["canary"], about["traffic"]["shadow"], about["up_to_date"]) == (None, None, True)
    assert (plain["league"], plain["champion"], plain["made_at"]) == (LEAGUE, "tictactoe@3", report["made_at"])
    matches, rows = Ledger(registry).matches(league=LEAGUE), registry.verdicts.all(LEAGUE)
    assert plain["games"] == sum(len(match.games) for match in matches) > plain["unique_games"]
    assert plain["environment"] == "pettingzoo.classic.tictactoe_v3"
    assert plain["leaderboard"] == documents[f"{BASE}/leaderboard"]["leaderboard"]
    assert (plain["by_side"], plain["roles"], plain["left_out"]) == ({}, {}, [])
    assert plain["payoff"] | {"shares": plain["shares"]} == documents[f"{BASE}/payoff"]["payoff"]
    assert {share["ref"] for share in plain["shares"]} == {row["ref"] for row in plain["leaderboard"]}
    assert [version["number"] for version in plain["versions"]] == [1, 2, 3]
    assert [verdict["verdict"] for verdict in plain["verdicts"]] == [row.id for row in reversed(rows)], "newest first"
    for verdict in plain["verdicts"]:
        assert verdict["curve"][-1] == [verdict["blocks"], verdict["llr"]]
        assert str(verdict["games"]) in verdict["reason"]
    assert [(event["kind"], event["champion"], event["before"]) for event in plain["promotions"]] == [
        ("rollback", "tictactoe@3", "tictactoe@1"),
        ("by hand", "tictactoe@1", "tictactoe@3"),
        ("promotion", "tictactoe@3", "tictactoe@2"),
        ("promotion", "tictactoe@2", None),
    ]
    assert plain["promotions"][1]["reason"] == reported_league.HOSTILE
    assert plain["promotions"][2]["verdict"] == plain["verdicts"][0]["verdict"]
    assert json.loads(json.dumps(plain, allow_nan=False)) == plain


def test_each_step_of_an_upset_has_its_moves_and_for_people_an_image(
    registry: Registry, report: dict[str, Any], plain: dict[str, Any]
) -> None:
    for upset, recording in zip(report["documents"][BASE]["summary"]["upsets"], recordings(report), strict=True):
        game = Ledger(registry).match(upset["match"]).games[upset["game"]]
        moves = [*game.opening, *game.actions]
        assert [move["action"] for step in recording["steps"] for move in step["moves"]] == moves
        assert (recording["length"], recording["every"], recording["fault"]) == (len(moves), 1, None)
        assert [step["opening"] for step in recording["steps"]] == [0 < step <= 2 for step in range(len(moves) + 1)]
        assert len(set(images(recording))) == len(recording["steps"]), "all images differ"
    assert plain["upsets"]
    for upset in plain["upsets"]:
        assert upset["score"] - upset["expected"] >= 0.4
        assert {step["picture"] for step in upset["steps"]} == {None}
        assert set(upset["players"].values()) == {upset["better"], upset["other"]}


def test_recorded_games_are_limited(
    registry: Registry, report: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """By their bytes and by their steps: a long game keeps some, with the first and the last."""
    limit = 40_000
    with monkeypatch.context() as patched:
        patched.setattr(module, "MOST_BYTES", limit)
        games = recordings(league_report(registry, LEAGUE))
    assert sum(len(json.dumps(game, separators=(",", ":"))) for game in games) <= limit
    for game in games:
        assert game["every"] > 1
        assert (game["steps"][0]["step"], game["steps"][-1]["step"]) == (0, game["length"])
    monkeypatch.setattr(service_requests, "MOST_STEPS", 4)
    for long, whole in zip(recordings(league_report(registry, LEAGUE)), recordings(report), strict=True):
        assert long["every"] > 1
        numbers = sorted({*range(0, long["length"], long["every"]), long["length"]})
        assert long["steps"] == [whole["steps"][number] for number in numbers]


def test_a_game_that_cannot_be_replayed_has_a_reason(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(match: str, *_: Any, **__: Any) -> Any:
        raise EnvironmentMismatch(f"match {match} is of another environment")

    monkeypatch.setattr(game_worker, "recorded_game", fail)
    report = league_report(registry, LEAGUE)
    assert {recording["code"] for recording in recordings(report)} == {"environment_mismatch"}
    for upset in plain_document(report)["upsets"]:
        assert upset["fault"] == f"match {upset['match']} is of another environment"


def plain_of(registry: Registry) -> dict[str, Any]:
    return plain_document(league_report(registry, LEAGUE))


def test_an_open_and_a_void_verdict_have_their_reasons(tmp_path: Path) -> None:
    """Exploiters and mixtures have their roles."""
    with reported_league.empty(tmp_path) as registry:
        for exploits in (None, "tictactoe@1", None):
            tictactoe.publish(registry, tictactoe.graph(), exploits=exploits)
        registry.publisher.publish_mixture(LEAGUE, {1: 0.25, 3: 0.75})
        verdict = open_verdict(registry, registry.leagues.get(LEAGUE), 1, "script:random", alpha=0.001)
        (opened,) = plain_of(registry)["verdicts"]
        registry.verdicts.void(verdict.id, "somebody stopped it")
        plain = plain_of(registry)
    (voided,) = plain["verdicts"]
    assert (opened["outcome"], opened["reason"][:16], opened["alpha"]) == ("open", "Undecided: after", 0.001)
    assert (voided["outcome"], voided["reason"]) == ("void", "Void: somebody stopped it.")
    assert (voided["anchors"], voided["confirmation"], voided["curve"]) == ([], None, [])
    mixture = "mixture of @1 25.0 %, @3 75.0 %"
    assert plain["roles"] == {"tictactoe@4": mixture, "tictactoe@2": "exploiter of tictactoe@1"}


def test_anchors_and_confirmations_are_included(tmp_path: Path) -> None:
    with reported_league.empty(tmp_path) as registry:
        for graph in (tictactoe.graph(wins=True), tictactoe.graph(wins=True, blocks=True)):
            tictactoe.publish(registry, graph)
        registry.aliases.set(LEAGUE, "champion", 1, expected=None, actor="me", reason="first")
        nightly(tictactoe.config(gate={"anchors": ["script:random"], "margin": 100}), registry=registry)
        newest = plain_of(registry)["verdicts"][0]
    assert newest["promoted"]
    assert [(anchor["ref"], anchor["outcome"]) for anchor in newest["anchors"]] == [("script:random", "not worse")]
    assert newest["confirmation"]["games"] == 40


def test_an_empty_league_and_one_with_different_sides_have_a_report(tmp_path: Path) -> None:
    with reported_league.empty(tmp_path / "empty") as registry:
        plain = plain_of(registry)
        with pytest.raises(UnknownLeague):
            league_report(registry, "chess")
    assert (plain["games"], plain["champion"], plain["payoff"], plain["leaderboard"]) == (0, None, None, [])
    assert (plain["shares"], plain["upsets"], plain["verdicts"], plain["promotions"]) == ([], [], [], [])
    with reported_league.league_with_roles(tmp_path / "roles") as registry:
        plain = plain_of(registry)
    assert (plain["scoring"], set(plain["by_side"])) == ("side", {"adversary", "good"})
    assert {row["games"] for rows in plain["by_side"].values() for row in rows} == {10}


def test_omissions_are_reported(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_CONTESTANTS", 3)
    monkeypatch.setattr(module, "MOST_VERDICTS", 1)
    report = league_report(registry, LEAGUE)
    assert len(report["documents"][f"{BASE}/verdicts"]["verdicts"]) == 3, "the list is whole"
    plain = plain_document(report)
    assert [verdict["candidate"] for verdict in plain["verdicts"]] == ["tictactoe@3"]
    assert plain["left_out"] == [
        "The payoff matrix contains the best 3 of 5 contestants.",
        "Only the newest 1 of 3 verdicts have their evidence.",
    ]


def test_a_report_waits_for_another_process_that_computes_the_results(tmp_path: Path) -> None:
    with reported_league.empty(tmp_path) as registry:
        other = Registry.open(registry.storage)
        locked, released = Event(), Event()

        def compute() -> None:
            with other.exclusive_lock(f"snapshots-{LEAGUE}"):
                locked.set()
                released.wait()

        computing = Thread(target=compute)
        computing.start()
        locked.wait()
        with mock.patch.object(module.time, "sleep", side_effect=lambda _: (released.set(), computing.join())) as waits:
            assert league_report(registry, LEAGUE)["documents"][BASE]["up_to_date"]
        waits.assert_called_once()
        other.close()


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


def test_hostile_text_is_data_in_the_file_and_only_its_own_scripts_and_styles_can_run() -> None:
    """An HTML parser reads it, as a browser would."""
    elements = Elements(report_file(REPORT))
    ((_, data),) = elements.all("script", id="report")
    assert json.loads(data) == REPORT
    assert len(elements.all("script")) == 4, "theme, import map, data and the start of the pages"
    assert not elements.all("img", src="x")
    ((attributes, _),) = elements.all("meta", **{"http-equiv": "Content-Security-Policy"})
    rules = dict(rule.split(" ", 1) for rule in (attributes["content"] or "").split("; "))
    assert rules["default-src"] == rules["base-uri"] == rules["form-action"] == "'none'"
    assert (rules["img-src"], rules["script-src"]) == ("data:", rules["style-src"])
    (nonce,) = re.findall(r"^'nonce-([\w-]{40,})'$", rules["script-src"])
    code = [attrs for tag, attrs, _ in elements.found if tag in ("script", "style") and attrs.get("id") != "report"]
    assert len(code) > 5
    assert {attrs["nonce"] for attrs in code} == {nonce}
    assert report_file(REPORT).count(nonce.encode()) == 0, "every file has its own"
    for tag, attributes, _ in elements.found:
        assert tag not in {"iframe", "object", "embed", "form", "base"}, "it refers to nothing else"
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
