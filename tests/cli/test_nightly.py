"""`league nightly` as a scheduler runs it: all leagues, exit codes, a webhook."""

import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock

from league.registry.registry import Registry
from tests.cli.conftest import League
from tests.evaluation import examples

Inbox = tuple[str, list[dict[str, Any]]]


@pytest.fixture
def inbox(request: pytest.FixtureRequest) -> Iterator[Inbox]:
    """A webhook: its URL, and what came in. With a parameter it refuses so many calls first."""
    received: list[dict[str, Any]] = []
    refusals = [getattr(request, "param", 0)]

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["content-length"]))
            refusals[0] -= 1
            self.send_response(503 if refusals[0] >= 0 else 204)
            self.end_headers()
            if refusals[0] < 0:
                received.append(json.loads(body))

        def log_message(self, *_: object) -> None:
            pass

    server = HTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}/night", received
    server.shutdown()
    server.server_close()
    thread.join()


def test_without_an_argument_all_registered_leagues_have_their_night(
    league: League, registry: Registry, home: Path
) -> None:
    told = league("nightly", "--workers", "0")
    assert told.code == 0, told.err
    champion = registry.aliases("tictactoe")["champion"]
    assert f"tictactoe: 3 judged, the champion is now tictactoe@{champion} (before: none)." in told.out
    assert "fresh games" in told.out
    assert f"tictactoe@{champion}" in (home / "reports" / "tictactoe.html").read_text()
    by_name = league("nightly", "tictactoe", "--workers", "0")
    assert (by_name.code, "no new version to judge" in by_name.out) == (0, True)


def test_without_any_league_it_says_so(league: League) -> None:
    told = league("nightly")
    assert (told.code, told.out) == (
        0,
        "No league is registered yet: name a file, such as configs/connect_four.yaml.\n",
    )


@pytest.mark.parametrize("inbox", [2], indirect=True)
def test_the_webhook_gets_a_summary_even_if_it_is_not_there_at_once(
    league: League, registry: Registry, inbox: Inbox
) -> None:
    url, received = inbox
    told = league("nightly", "--workers", "0", "--webhook", url, "--json")
    assert told.code == 0, told.err
    (document,) = received
    assert document["text"].startswith("tictactoe: 3 judged, the champion is now")
    assert document["leagues"] == told.json["leagues"]


@pytest.mark.parametrize("inbox", [9], indirect=True)
def test_a_webhook_that_nobody_answers_is_told_and_the_night_is_kept(
    league: League, registry: Registry, inbox: Inbox
) -> None:
    told = league("nightly", "--workers", "0", "--webhook", inbox[0])
    assert told.code == 1
    assert "did not take the night's summary in 3 attempts: it answered 503" in told.err
    assert registry.aliases("tictactoe")["champion"]
    assert league("nightly", "--webhook", "here").code == 2


def test_a_night_beside_another_is_refused_so_that_a_scheduler_tries_again(
    league: League, registry: Registry, home: Path
) -> None:
    (home / "locks").mkdir()
    with FileLock(home / "locks" / "nightly-tictactoe.lock"):
        told = league("nightly")
    assert (told.code, told.err.count("\n")) == (75, 1)
    assert "another process is at work on nightly-tictactoe" in told.err


def test_a_league_that_fails_does_not_keep_the_others_from_their_night(league: League, registry: Registry) -> None:
    broken = examples.config().model_copy(update={"league": "broken"})
    registry.register(broken, registry.league("tictactoe").interface)
    gone = broken.environment.model_copy(update={"entry_point": "nowhere.to_be_found"})
    registry.register(broken.model_copy(update={"environment": gone}), registry.league("tictactoe").interface)
    told = league("nightly", "--workers", "0")
    assert told.code == 1
    assert "broken: " in told.err
    assert "nowhere.to_be_found" in told.err
    assert "tictactoe: 3 judged" in told.out


def test_a_version_that_cannot_be_judged_is_an_exit_code_of_1(league: League, registry: Registry) -> None:
    (registry.artifacts.root / "tictactoe" / "2" / "shared.onnx").write_bytes(b"not a graph")
    told = league("nightly", "--workers", "0", "--json")
    assert told.code == 1
    assert any("tictactoe@2" in fault for fault in told.json["faults"])
    assert len(told.json["leagues"][0]["verdicts"]) == 2


def test_a_verdict_is_voided_with_a_reason(league: League, registry: Registry) -> None:
    verdict = league("nightly", "--workers", "0", "--json").json["leagues"][0]["verdicts"][0]["verdict"]
    told = league("void", verdict, "--reason", "a broken machine", "--actor", "ann")
    assert (told.code, told.out) == (0, f"{verdict} on tictactoe@1 is void.\n")
    row = registry.verdict(verdict)
    assert row.evidence is not None
    assert (row.outcome, row.evidence["note"]) == ("void", "voided by ann: a broken machine")
    assert league("void", "nothing", "--reason", "x").code == 2
