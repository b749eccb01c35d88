import base64
import json
from collections.abc import Iterator
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
from policy_league.cli.evaluation.report_contents import league_report, plain_document
from serve_app.openapi.document import document
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
    return [found for path, found in report["documents"].items() if "/games/" in path]


def images(recording: dict[str, Any]) -> list[bytes]:
    kind, data = zip(*(step["picture"].split(",") for step in recording["steps"]), strict=True)
    assert set(kind) == {"data:image/png;base64"}
    return [Image.open(BytesIO(base64.b64decode(image))).convert("RGB").tobytes() for image in data]


def test_documents_have_the_shape_of_the_api(report: dict[str, Any]) -> None:
    schemas = {"components": document(QUICK, [])["components"]}
    for path, schema in SCHEMAS.items():
        Draft202012Validator({"$ref": f"#/components/schemas/{schema}"} | schemas).validate(report["documents"][path])
    for path, found in report["documents"].items():
        if path.startswith(f"{BASE}/verdicts/"):
            Draft202012Validator({"$ref": "#/components/schemas/Verdict"} | schemas).validate(found)
            assert found["curve"], path
    assert SCHEMAS.keys() < report["documents"].keys()


def test_lists_are_whole(registry: Registry, report: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_PAGE", 2)
    paged = league_report(registry, LEAGUE)
    assert paged["documents"] == report["documents"]
    leaderboard = paged["documents"][f"{BASE}/leaderboard"]
    assert [row["rank"] for row in leaderboard["leaderboard"]] == [1, 2, 3, 4, 5]
    versions = paged["documents"][f"{BASE}/versions"]
    assert ([version["version"] for version in versions["versions"]], versions["next"]) == ([3, 2, 1], None)


def test_what_only_a_running_server_has_is_left_out(report: dict[str, Any]) -> None:
    about = report["documents"][BASE]
    assert (about["replicas"], about["faults"], about["summary"]["earlier"]) == ([], [], [])
    assert (about["traffic"]["canary"], about["traffic"]["shadow"], about["up_to_date"]) == (None, None, True)


def test_the_plain_document_has_all_results(registry: Registry, report: dict[str, Any], plain: dict[str, Any]) -> None:
    documents = report["documents"]
    assert (plain["league"], plain["champion"], plain["made_at"]) == (LEAGUE, "tictactoe@3", report["made_at"])
    matches = Ledger(registry).matches(league=LEAGUE)
    assert plain["games"] == sum(len(match.games) for match in matches) > plain["unique_games"]
    assert plain["environment"] == "pettingzoo.classic.tictactoe_v3"
    assert plain["leaderboard"] == documents[f"{BASE}/leaderboard"]["leaderboard"]
    assert (plain["by_side"], plain["roles"], plain["left_out"]) == ({}, {}, [])
    table = documents[f"{BASE}/payoff"]["payoff"]
    assert plain["payoff"] | {"shares": plain["shares"]} == table
    assert {share["ref"] for share in plain["shares"]} == {row["ref"] for row in plain["leaderboard"]}
    assert [version["number"] for version in plain["versions"]] == [1, 2, 3]
    assert json.loads(json.dumps(plain, allow_nan=False)) == plain


def test_verdicts_are_listed_newest_first_with_their_evidence(registry: Registry, plain: dict[str, Any]) -> None:
    rows = registry.verdicts.all(LEAGUE)
    assert [verdict["verdict"] for verdict in plain["verdicts"]] == [row.id for row in reversed(rows)]
    for verdict in plain["verdicts"]:
        assert verdict["curve"][-1] == [verdict["blocks"], verdict["llr"]]
        assert str(verdict["games"]) in verdict["reason"]


def test_promotions_have_kind_actor_and_reason(plain: dict[str, Any]) -> None:
    assert [(event["kind"], event["champion"], event["before"]) for event in plain["promotions"]] == [
        ("rollback", "tictactoe@3", "tictactoe@1"),
        ("by hand", "tictactoe@1", "tictactoe@3"),
        ("promotion", "tictactoe@3", "tictactoe@2"),
        ("promotion", "tictactoe@2", None),
    ]
    assert plain["promotions"][1]["reason"] == reported_league.HOSTILE
    assert plain["promotions"][2]["verdict"] == plain["verdicts"][0]["verdict"]


def test_each_step_of_an_upset_has_its_moves_and_image(registry: Registry, report: dict[str, Any]) -> None:
    for upset, recording in zip(report["documents"][BASE]["summary"]["upsets"], recordings(report), strict=True):
        game = Ledger(registry).match(upset["match"]).games[upset["game"]]
        moves = [*game.opening, *game.actions]
        assert [move["action"] for step in recording["steps"] for move in step["moves"]] == moves
        assert (recording["length"], recording["every"], recording["fault"]) == (len(moves), 1, None)
        assert [step["opening"] for step in recording["steps"]] == [0 < step <= 2 for step in range(len(moves) + 1)]
        assert len(set(images(recording))) == len(recording["steps"]), "all images differ"


def test_programs_get_no_images(plain: dict[str, Any]) -> None:
    assert plain["upsets"]
    for upset in plain["upsets"]:
        assert upset["score"] - upset["expected"] >= 0.4
        assert {step["picture"] for step in upset["steps"]} == {None}
        assert set(upset["players"].values()) == {upset["better"], upset["other"]}


def test_the_size_of_recorded_games_is_limited(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    limit = 40_000
    monkeypatch.setattr(module, "MOST_BYTES", limit)
    games = recordings(league_report(registry, LEAGUE))
    assert sum(len(json.dumps(game, separators=(",", ":"))) for game in games) <= limit
    for game in games:
        assert game["every"] > 1
        assert (game["steps"][0]["step"], game["steps"][-1]["step"]) == (0, game["length"])


def test_a_long_game_keeps_some_steps_with_the_first_and_the_last(
    registry: Registry, report: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
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


def test_an_open_and_a_void_verdict_have_their_reasons(tmp_path: Path) -> None:
    with reported_league.empty(tmp_path) as registry:
        tictactoe.publish(registry, tictactoe.graph())
        verdict = open_verdict(registry, registry.leagues.get(LEAGUE), 1, "script:random", alpha=0.001)
        (opened,) = plain_document(league_report(registry, LEAGUE))["verdicts"]
        registry.verdicts.void(verdict.id, "somebody stopped it")
        (voided,) = plain_document(league_report(registry, LEAGUE))["verdicts"]
    assert (opened["outcome"], opened["reason"][:16], opened["alpha"]) == ("open", "Undecided: after", 0.001)
    assert (voided["outcome"], voided["reason"]) == ("void", "Void: somebody stopped it.")
    assert (voided["anchors"], voided["confirmation"], voided["curve"]) == ([], None, [])


def test_anchors_and_confirmations_are_included(tmp_path: Path) -> None:
    with reported_league.empty(tmp_path) as registry:
        for graph in (tictactoe.graph(wins=True), tictactoe.graph(wins=True, blocks=True)):
            tictactoe.publish(registry, graph)
        registry.aliases.set(LEAGUE, "champion", 1, expected=None, actor="me", reason="first")
        gate = {"anchors": ["script:random"], "margin": 100}
        nightly(tictactoe.config(gate=gate), registry=registry)
        newest = plain_document(league_report(registry, LEAGUE))["verdicts"][0]
    assert newest["promoted"]
    assert [(anchor["ref"], anchor["outcome"]) for anchor in newest["anchors"]] == [("script:random", "not worse")]
    assert newest["confirmation"]["games"] == 40


def test_exploiters_and_mixtures_have_their_roles(tmp_path: Path) -> None:
    with reported_league.empty(tmp_path) as registry:
        for exploits in (None, "tictactoe@1"):
            tictactoe.publish(registry, tictactoe.graph(), exploits=exploits)
        tictactoe.publish(registry, tictactoe.graph(wins=True))
        registry.publisher.publish_mixture(LEAGUE, {1: 0.25, 3: 0.75})
        roles = plain_document(league_report(registry, LEAGUE))["roles"]
    assert roles == {
        "tictactoe@4": "mixture of @1 25.0 %, @3 75.0 %",
        "tictactoe@2": "exploiter of tictactoe@1",
    }


def test_an_empty_league_has_a_report(tmp_path: Path) -> None:
    with reported_league.empty(tmp_path) as registry:
        plain = plain_document(league_report(registry, LEAGUE))
        with pytest.raises(UnknownLeague):
            league_report(registry, "chess")
    assert (plain["games"], plain["champion"], plain["payoff"], plain["leaderboard"]) == (0, None, None, [])
    assert (plain["shares"], plain["upsets"], plain["verdicts"], plain["promotions"]) == ([], [], [], [])


def test_different_sides_are_rated_separately(tmp_path: Path) -> None:
    with reported_league.league_with_roles(tmp_path) as registry:
        plain = plain_document(league_report(registry, LEAGUE))
    assert plain["scoring"] == "side"
    assert set(plain["by_side"]) == {"adversary", "good"}
    for rows in plain["by_side"].values():
        assert {row["games"] for row in rows} == {10}


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
