"""`league evaluate`, `replay`, `report`, `nightly`, `verify` and `void`, also with a contestant of another server."""

import json
import os
import subprocess
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest
import yaml
from pettingzoo.classic.tictactoe import tictactoe as tictactoe_v3
from PIL import Image
from sqlalchemy import select

from evaluation.matches.game_records import forfeits
from league.config.gate import AnchorConfig, GateConfig
from league.registry.registry import Registry
from league.registry.storage.rows import TrainingNightRow, VerdictRow
from league.registry.storage.tables import MatchTable
from league.results.ledger import Ledger
from league.settings import Storage
from policy_league.cli.evaluation.nightly import night_document, summary_of_night
from serve_app.runtime.launch import running
from tests.support.command import COMMAND, League, Result, environment
from tests.support.leagues import tictactoe
from tests.support.leagues.judged_league import promote, reconfigure
from tests.support.policies.illegal_action_graph import illegal_action_graph
from tests.support.waiting import until

EVALUATE = ("evaluate", "tictactoe", "--workers", "0")


def test_evaluations_are_printed_as_json_and_as_tables(league: League, registry: Registry) -> None:
    document = league(*EVALUATE, "--blocks", "20", "--json").json
    leaderboard = {standing["ref"]: standing for standing in document["leaderboard"]}
    assert set(leaderboard) == {"tictactoe@1", "tictactoe@2", "tictactoe@3", "script:random", "script:one_ply"}
    for standing in leaderboard.values():
        assert {"mean_return", "score", "rating", "interval", "games"} <= set(standing)
    for shares in document["population"].values():
        assert sum(share["value"] for share in shares) == pytest.approx(1)
        assert all(share["low"] <= share["high"] for share in shares)
    out = league(*EVALUATE, "--blocks", "20").out
    assert all(part in out for part in ("tictactoe@3", "script:one_ply", "α-Rank"))
    options = ("--schedule", "adaptive", "--games", "41")
    out = league(*EVALUATE, *options).out
    assert ("40 games" in out, "stopped by --games" in out) == (True, True)
    document = league(*EVALUATE, *options, "--json").json
    assert (document["kind"], document["stopped_by"], document["games"]) == ("adaptive", "games", 40)
    assert document["population"] is None


def test_a_file_names_its_league(league: League, home: Path, tmp_path: Path) -> None:
    """It is registered, as by `league train` and `league nightly`."""
    config = tmp_path / "own.yaml"
    config.write_text("league: own\nenvironment: {entry_point: pettingzoo.classic.tictactoe_v3}\n")
    document = league("evaluate", str(config), "--blocks", "1", "--workers", "0", "--json").json
    assert (document["league"], document["games"]) == ("own", 2)
    assert "own" in Registry.open(Storage.at(home)).leagues.names()


@pytest.mark.slow
def test_a_terminated_evaluation_exits_like_any_terminated_process(registry: Registry, home: Path) -> None:
    """Also once Ray has set its handler."""
    played = select(MatchTable.position).limit(1)
    options = ("--blocks", "100000", "--workers", "1", "--schedule", "round_robin")
    command = [*COMMAND, "evaluate", "tictactoe", *options]
    with subprocess.Popen(command, env=os.environ | environment(home), stderr=subprocess.PIPE, text=True) as process:
        until(lambda: registry.database.rows(played) or process.poll() is not None)
        process.terminate()
        _, errors = process.communicate()
    assert process.returncode == 143, errors
    assert "Traceback" not in errors
    assert "SIGTERM received" not in errors  # Ray's handler, which aborts the process if printing is slow


def test_games_are_rendered_and_described(league: League, registry: Registry, tmp_path: Path) -> None:
    """Live, recorded, and until a forfeit."""

    def rendered(name: str, *arguments: str) -> str:
        result = league("replay", *arguments, "--out", str(tmp_path / name))
        assert result.code == 0, result.err
        return result.out

    out = rendered("game.gif", "tictactoe@3", "script:one_ply", "--side", "player_2")
    assert "player_1 (script:one_ply)" in out
    assert "player_2 (tictactoe@3)" in out
    with Image.open(tmp_path / "game.gif") as image:
        assert f"{image.n_frames - 1} steps" in out
    faulty = tictactoe.publish(registry, illegal_action_graph(crashes=False)).ref
    result = league(*EVALUATE, "tictactoe@1", faulty, "--blocks", "4")
    matches = Ledger(registry).matches(league="tictactoe")
    assert f"{faulty} forfeited {forfeits(matches, faulty)} games" in result.err
    out = rendered("match.webp", "--match", matches[0].id, "--game", "1")
    assert f"player_1 ({matches[0].contestants[matches[0].games[1].sides[0]]})" in out
    match, index = next((m, i) for m in matches for i, game in enumerate(m.games) if game.forfeits)
    out = rendered("forfeit.webp", "--match", match.id, "--game", str(index))
    assert f"forfeited by {faulty} as {match.games[index].forfeits[0].agent}: illegal action (action" in out
    assert "max-frames" not in out


def test_reports(league: League, registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    league(*EVALUATE, "--blocks", "4")
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[3]))
    monkeypatch.chdir(tmp_path)
    result = league("report", "tictactoe")
    assert result.code == 0, result.err
    assert result.out.startswith("tictactoe-report.html: 80 games, 0 verdicts, ")
    assert (tmp_path / "tictactoe-report.html").read_text(encoding="utf-8").startswith("<!doctype html>")
    assert league("report", "tictactoe", "--out", "page.html").code == 0
    assert (tmp_path / "page.html").exists()
    document = league("report", "tictactoe", "--json").json
    assert (document["league"], document["games"], len(document["versions"])) == ("tictactoe", 80, 3)
    assert document["leaderboard"][0]["rank"] == 1
    assert {step["picture"] for game in document["upsets"] for step in game["steps"]} <= {None}


STRONG, WEAK = 1, 2
"""Versions of the other league."""


@dataclass(frozen=True)
class Other:
    """The server of another league: the URL of its model, and its registry."""

    model: str
    registry: Registry

    def version(self, number: int) -> str:
        return f"{self.model}/versions/{number}"


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Other]:
    registry = tictactoe.registry(Storage.at(tmp_path_factory.mktemp("other")).home)
    for graph in (tictactoe.graph(wins=True, blocks=True, order=tictactoe.CENTRE_FIRST), tictactoe.graph()):
        tictactoe.publish(registry, graph)
    promote(registry, STRONG)
    with running(registry.storage, replicas=1) as url:
        yield Other(f"{url}/v2/models/tictactoe", registry)
    registry.close()


def scores(result: Result) -> dict[str, float]:
    assert result.code == 0, result.err
    return {row["ref"]: row["score"] for row in result.json["leaderboard"]}


@pytest.mark.slow
@pytest.mark.parametrize("workers", ["0", "2"])
def test_a_remote_contestant_is_evaluated_by_its_version(
    league: League, league_process: League, registry: Registry, other: Other, workers: str
) -> None:
    """Another version is another contestant."""
    run, options = league if workers == "0" else league_process, ("--blocks", "8", "--workers", workers, "--json")
    first = scores(run("evaluate", "tictactoe", "tictactoe@1", other.model, *options))
    assert first[other.version(STRONG)] > first["tictactoe@1"]
    again = scores(run("evaluate", "tictactoe", "tictactoe@1", other.version(STRONG), *options))
    assert again == first, "the same contestant: no game was played again"
    both = scores(run("evaluate", "tictactoe", other.model, other.version(WEAK), *options))
    assert {other.version(STRONG), other.version(WEAK)} <= both.keys()


@pytest.mark.slow
def test_a_candidate_that_loses_to_a_remote_anchor_is_not_promoted(league: League, home: Path, other: Other) -> None:
    registry = tictactoe.registry(home, gate={"anchors": [{"ref": other.model, "margin": 40}], "earlier_champions": 0})
    for graph in (tictactoe.graph(), tictactoe.graph(blocks=True)):
        tictactoe.publish(registry, graph)
    promote(registry, 1)
    result = league("nightly", "tictactoe", "--workers", "0", "--json")
    assert result.code == 0, result.err
    (verdict,) = result.json["leagues"][0]["verdicts"]
    (anchor,) = verdict["anchors"]
    assert (anchor["ref"], anchor["outcome"], verdict["outcome"]) == (other.version(STRONG), "inferior", "reject")
    assert registry.aliases.current("tictactoe")["champion"] == 1
    assert other.version(STRONG) in (home / "reports" / "tictactoe.html").read_text()


@pytest.mark.slow
def test_games_with_it_are_rendered(league: League, registry: Registry, other: Other, tmp_path: Path) -> None:
    out = tmp_path / "game.gif"
    result = league("replay", "tictactoe@1", other.model, "--out", str(out))
    assert result.code == 0, result.err
    assert f"player_2 ({other.version(STRONG)})" in result.out
    with Image.open(out) as image:
        assert f"{image.n_frames - 1} steps" in result.out
    league(*EVALUATE, "tictactoe@1", other.model, "--blocks", "1")
    matches = Ledger(registry).matches(league="tictactoe")
    match = next(match for match in matches if other.version(STRONG) in match.contestants)
    recorded = league("replay", "--match", match.id, "--out", str(tmp_path / "recorded.gif"))
    assert recorded.code == 0, recorded.err
    assert other.version(STRONG) in recorded.out


def test_an_evaluation_ends_if_the_server_is_gone(
    league: League, registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("league.policies.open_inference.RETRY_DEADLINE", 0.0)
    result = league(*EVALUATE, "tictactoe@1", "http://127.0.0.1:9/v2/models/tictactoe")
    assert (result.code, result.err.count("\n")) == (1, 1)
    assert "http://127.0.0.1:9/v2/models/tictactoe cannot be reached" in result.err


Inbox = tuple[str, list[dict[str, Any]]]


@pytest.fixture
def inbox(request: pytest.FixtureRequest) -> Iterator[Inbox]:
    """A webhook: its URL, and the received documents. With a parameter it rejects this number of calls first."""
    received: list[dict[str, Any]] = []
    rejections = [getattr(request, "param", 0)]

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["content-length"]))
            rejections[0] -= 1
            if rejections[0] < 0:
                received.append(json.loads(body))
            self.send_response(503 if rejections[0] >= 0 else 204)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    server = HTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}/night", received
    server.shutdown()
    server.server_close()
    thread.join()


NIGHTLY = ("nightly", "--workers", "0")


@pytest.mark.parametrize("inbox", [9], indirect=True)
def test_all_leagues_are_run_also_if_the_webhook_fails(
    league: League, registry: Registry, home: Path, inbox: Inbox
) -> None:
    result = league(*NIGHTLY, "--webhook", inbox[0])
    assert result.code == 1
    assert "did not accept the summary of the nightly run in 3 attempts: status 503" in result.err
    champion = registry.aliases.current("tictactoe")["champion"]
    assert f"tictactoe: 3 tested, the champion is now tictactoe@{champion} (before: none)." in result.out
    assert "tictactoe@1 against script:random" in result.out
    assert "new games" in result.out
    assert f"tictactoe@{champion}" in (home / "reports" / "tictactoe.html").read_text()
    by_name = league(*NIGHTLY, "tictactoe")
    assert (by_name.code, "no new versions to test" in by_name.out) == (0, True)
    assert league(*NIGHTLY, "--webhook", "here").code == 2
    with registry.exclusive_lock("nightly-tictactoe"):
        concurrent = league("nightly")
    assert (concurrent.code, concurrent.err.count("\n")) == (75, 1), "a temporary failure"
    assert "another process is running nightly-tictactoe" in concurrent.err


@pytest.mark.parametrize("inbox", [2], indirect=True)
def test_the_webhook_is_retried(league: League, registry: Registry, inbox: Inbox) -> None:
    url, received = inbox
    result = league(*NIGHTLY, "--webhook", url, "--json")
    assert result.code == 0, result.err
    (document,) = received
    assert document["text"].startswith("tictactoe: 3 tested, the champion is now")
    assert document["leagues"] == result.json["leagues"]


def test_a_league_without_a_champion_or_a_version_is_reported(league: League, registry: Registry) -> None:
    solver = AnchorConfig(ref="script:solver", mode="at_least")
    strict = registry.leagues.get("tictactoe").config.model_copy(update={"gate": GateConfig(anchors=(solver,))})
    reconfigure(registry, strict)
    result = league(*NIGHTLY, "tictactoe")
    assert "3 tested, there is no champion, as no version has passed the gate yet." in result.out


def test_without_any_league_this_is_reported(league: League) -> None:
    result = league("nightly")
    assert (result.code, result.out) == (
        0,
        "No league is registered yet. Name a configuration, such as connect_four or a YAML file.\n",
    )


def test_leagues_that_cannot_be_run_do_not_affect_the_others(league: League, registry: Registry) -> None:
    row = registry.leagues.get("tictactoe")
    missing = row.config.environment.model_copy(update={"entry_point": "nowhere.to_be_found"})
    for name, playing in (("idle", row.config.environment), ("broken", missing)):
        config = row.config.model_copy(update={"league": name, "environment": playing})
        registry.leagues.register(config, row.interface)
    registry.leagues.archive("idle")
    result = league(*NIGHTLY, "idle", "nothing", "broken", "tictactoe", "--json")
    assert result.code == 2
    assert result.err.startswith("skipped: league idle is archived: `league archive idle --undo`")
    assert "league: there is no league 'nothing'; known: " in result.err
    assert "broken: " in result.err
    assert "nowhere.to_be_found" in result.err
    assert [report["league"] for report in result.json["leagues"]] == ["tictactoe"]
    assert len(result.json["faults"]) == 2
    assert league(*NIGHTLY, "idle", "tictactoe").code == 0


def test_a_version_that_cannot_be_tested_gives_exit_code_1(league: League, registry: Registry) -> None:
    (registry.artifacts.root / "tictactoe" / "2" / "shared.onnx").write_bytes(b"not a graph")
    result = league("nightly", "--workers", "0", "--json")
    assert result.code == 1
    assert any("tictactoe@2" in fault for fault in result.json["faults"])
    assert len(result.json["leagues"][0]["verdicts"]) == 2


def test_the_summary_of_a_night_names_the_version_that_training_started_from() -> None:
    """The champion, version 3, was imported or is a mixture."""
    for start, text in ((2, "from tictactoe@2"), (None, "from scratch")):
        steps = {"train": {"versions": ["tictactoe@4"], "start": start}, "measure": {"exploitability": None}}
        date = datetime.now(UTC)
        night = TrainingNightRow(
            id=9, number=5, league="tictactoe", parent=3, steps=steps, began_at=date, ended_at=date
        )
        assert summary_of_night(night) == [f"tictactoe: night 5 trained tictactoe@4 {text}."]
        assert [night_document(night)[name] for name in ("night", "number", "parent")] == [9, 5, start]


def test_verdicts_are_verified_refuted_and_voided(
    league: League, registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (config := tmp_path / "tictactoe.yaml").write_text(
        yaml.safe_dump(tictactoe.config().model_dump(mode="json", by_alias=True))
    )
    (report,) = league(*NIGHTLY, str(config), "--json").json["leagues"]
    assert report["champion"] == f"tictactoe@{registry.aliases.current('tictactoe')['champion']}"
    rated = league("versions", "tictactoe", "--json").json["versions"]
    assert all(version["rating"] is not None for version in rated)
    verdict = report["verdicts"][0]["verdict"]
    row = registry.verdicts.get(verdict)
    assert verdict.startswith(f"tictactoe-verdict-{row.short_id}")
    assert league("verify", row.short_id, "--json").json["verdict"] == verdict
    result = league("verify", verdict, "--replays", "3")
    assert (result.code, "3 games replayed" in result.out) == (0, True)

    step = tictactoe_v3.raw_env.step

    def step_without_rewards(self: Any, action: int | None) -> None:
        step(self, action)
        self.rewards = dict.fromkeys(self.rewards, float("nan"))

    with monkeypatch.context() as patched:
        patched.setattr(tictactoe_v3.raw_env, "step", step_without_rewards)
        refuted = league("verify", verdict, "--replays", "1")
    assert (refuted.code, refuted.err.count("\n")) == (1, 1)
    assert "cannot be replayed: agent player_1 got a reward of nan" in refuted.err
    with registry.database.write() as session:
        session.get_one(VerdictRow, verdict).evidence = {**row.evidence, "llr": 99.0}
    refuted = league("verify", verdict)
    assert (refuted.code, refuted.err.count("\n")) == (1, 1)
    assert "llr is 99.0, but the games give" in refuted.err

    with registry.database.write() as session:
        session.get_one(VerdictRow, verdict).evidence = row.evidence
    result = league("void", row.short_id, "--reason", "a broken machine", "--actor", "ann")
    assert (result.code, result.out) == (0, f"Verdict {row.short_id} on tictactoe@1 is now void.\n")
    voided = registry.verdicts.get(verdict)
    assert (voided.outcome, voided.evidence["note"]) == ("void", "voided by ann: a broken machine")
    again = league("void", row.short_id, "--reason", "fire", "--actor", "bob").out
    assert again.startswith(f"Verdict {row.short_id} on tictactoe@1 was already void, voided by ann: a broken machine.")
    assert league("verify", row.short_id).out.startswith("void: ")
    ambiguous = league("void", "tictactoe-verdict", "--reason", "x")
    assert (ambiguous.code, row.short_id in ambiguous.err) == (2, True)
