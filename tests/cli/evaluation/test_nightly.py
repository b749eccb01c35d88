"""`league nightly` as run by a scheduler: all leagues, exit codes, a webhook."""

import json
import threading
from collections.abc import Iterator
from datetime import UTC, datetime
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock

from league.config.gate import AnchorConfig, GateConfig
from league.registry.registry import Registry
from league.registry.storage.rows import TrainingNightRow
from policy_league.cli.evaluation.nightly import night_document, summary_of_night
from tests.support.command import League
from tests.support.leagues import tictactoe

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


def test_without_an_argument_all_registered_leagues_are_run(league: League, registry: Registry, home: Path) -> None:
    result = league("nightly", "--workers", "0")
    assert result.code == 0, result.err
    champion = registry.aliases.current("tictactoe")["champion"]
    assert f"tictactoe: 3 tested, the champion is now tictactoe@{champion} (before: none)." in result.out
    assert "new games" in result.out
    assert f"tictactoe@{champion}" in (home / "reports" / "tictactoe.html").read_text()
    by_name = league("nightly", "tictactoe", "--workers", "0")
    assert (by_name.code, "no new versions to test" in by_name.out) == (0, True)


def test_a_league_whose_versions_all_fail_the_gate_has_no_champion(league: League, registry: Registry) -> None:
    row = registry.leagues.get("tictactoe")
    solver = AnchorConfig(ref="script:solver", mode="at_least")
    strict = row.config.model_copy(update={"gate": GateConfig(anchors=(solver,))})
    registry.leagues.register(strict, row.interface)
    result = league("nightly", "tictactoe", "--workers", "0")
    assert "3 tested, there is no champion, as no version has passed the gate yet." in result.out


def test_without_any_league_this_is_reported(league: League) -> None:
    result = league("nightly")
    assert (result.code, result.out) == (
        0,
        "No league is registered yet. Name a configuration, such as connect_four or a YAML file.\n",
    )


@pytest.mark.parametrize("inbox", [2], indirect=True)
def test_the_webhook_is_retried(league: League, registry: Registry, inbox: Inbox) -> None:
    url, received = inbox
    result = league("nightly", "--workers", "0", "--webhook", url, "--json")
    assert result.code == 0, result.err
    (document,) = received
    assert document["text"].startswith("tictactoe: 3 tested, the champion is now")
    assert document["leagues"] == result.json["leagues"]


@pytest.mark.parametrize("inbox", [9], indirect=True)
def test_a_failing_webhook_is_reported_and_the_run_is_kept(league: League, registry: Registry, inbox: Inbox) -> None:
    result = league("nightly", "--workers", "0", "--webhook", inbox[0])
    assert result.code == 1
    assert "did not accept the summary of the nightly run in 3 attempts: status 503" in result.err
    assert registry.aliases.current("tictactoe")["champion"]
    assert league("nightly", "--webhook", "here").code == 2


def test_a_concurrent_run_is_rejected_with_a_temporary_exit_code(
    league: League, registry: Registry, home: Path
) -> None:
    (home / "locks").mkdir()
    with FileLock(home / "locks" / "nightly-tictactoe.lock"):
        result = league("nightly")
    assert (result.code, result.err.count("\n")) == (75, 1)
    assert "another process is running nightly-tictactoe" in result.err


def test_a_failing_league_does_not_affect_the_others(league: League, registry: Registry) -> None:
    broken = tictactoe.config().model_copy(update={"league": "broken"})
    registry.leagues.register(broken, registry.leagues.get("tictactoe").interface)
    missing = broken.environment.model_copy(update={"entry_point": "nowhere.to_be_found"})
    registry.leagues.register(
        broken.model_copy(update={"environment": missing}), registry.leagues.get("tictactoe").interface
    )
    failed = league("nightly", "--workers", "0")
    assert failed.code == 2, "the configuration of a league is invalid"
    assert "broken: " in failed.err
    assert "nowhere.to_be_found" in failed.err
    assert "tictactoe: 3 tested" in failed.out


def test_unknown_and_archived_leagues_do_not_prevent_the_others(league: League, registry: Registry) -> None:
    idle = registry.leagues.get("tictactoe")
    registry.leagues.register(idle.config.model_copy(update={"league": "idle"}), idle.interface)
    registry.leagues.archive("idle")
    result = league("nightly", "idle", "nothing", "tictactoe", "--workers", "0", "--json")
    assert result.code == 2
    assert result.err.startswith("skipped: league idle is archived: `league archive idle --undo`")
    assert "league: there is no league 'nothing'; known: " in result.err
    assert [report["league"] for report in result.json["leagues"]] == ["tictactoe"]
    assert len(result.json["faults"]) == 1
    assert league("nightly", "idle", "tictactoe", "--workers", "0").code == 0


def test_a_version_that_cannot_be_tested_gives_exit_code_1(league: League, registry: Registry) -> None:
    (registry.artifacts.root / "tictactoe" / "2" / "shared.onnx").write_bytes(b"not a graph")
    result = league("nightly", "--workers", "0", "--json")
    assert result.code == 1
    assert any("tictactoe@2" in fault for fault in result.json["faults"])
    assert len(result.json["leagues"][0]["verdicts"]) == 2


@pytest.mark.parametrize(
    ("train", "start"),
    [
        ({"start": 2}, "from tictactoe@2"),
        ({"start": None}, "from scratch"),
    ],
)
def test_the_summary_of_a_night_names_the_version_that_training_started_from(train: dict[str, Any], start: str) -> None:
    """The champion, version 3, was imported or is a mixture."""
    steps = {"train": {"versions": ["tictactoe@4"]} | train, "measure": {"exploitability": None}}
    now = datetime.now(UTC)
    night = TrainingNightRow(id=9, number=5, league="tictactoe", parent=3, steps=steps, began_at=now, ended_at=now)
    assert summary_of_night(night) == [f"tictactoe: night 5 trained tictactoe@4 {start}."]
    assert [night_document(night)[name] for name in ("night", "number", "parent")] == [9, 5, train["start"]]


def test_a_verdict_is_voided_with_a_reason(league: League, registry: Registry) -> None:
    verdict = league("nightly", "--workers", "0", "--json").json["leagues"][0]["verdicts"][0]["verdict"]
    short = registry.verdicts.get(verdict).short_id
    assert verdict.startswith(f"tictactoe-verdict-{short}")
    assert league("verify", short, "--json").json["verdict"] == verdict
    result = league("void", short, "--reason", "a broken machine", "--actor", "ann")
    assert (result.code, result.out) == (0, f"Verdict {short} on tictactoe@1 is now void.\n")
    row = registry.verdicts.get(verdict)
    assert row.evidence is not None
    assert (row.outcome, row.evidence["note"]) == ("void", "voided by ann: a broken machine")
    again = league("void", short, "--reason", "fire", "--actor", "bob")
    assert again.out.startswith(f"Verdict {short} on tictactoe@1 was already void, voided by ann: a broken machine.")
    assert league("verify", short).out.startswith("void: ")
    ambiguous = league("void", "tictactoe-verdict", "--reason", "x")
    assert (ambiguous.code, short in ambiguous.err) == (2, True)
    assert league("void", "nothing", "--reason", "x").code == 2
