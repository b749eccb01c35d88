"""Versions on the command line: listed, noted, promoted, mixed, retired, exported and imported."""

import json
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import update

from evaluation.gating.verdicts import open_verdict
from evaluation.service.snapshots import refresh
from league.config.league import LeagueConfig
from league.policies import load
from league.policies.onnx import OnnxPolicy
from league.registry.registry import Registry
from league.registry.storage.exports import CARD
from league.registry.storage.rows import LeagueRow
from league.registry.storage.tables import VersionTable
from league.results.payoffs import MetaStrategy
from tests.support.command import League
from tests.support.databases import on_both_databases
from tests.support.leagues import tictactoe
from tests.support.leagues.judged_league import promote
from tests.support.policies.foreign_graphs import foreign
from tests.support.policies.graphs import masked_mlp
from tests.support.servers.streaming import listening
from training.importing import checks


@on_both_databases
def test_versions_are_listed_with_their_aliases_and_notes(league: League, registry: Registry) -> None:
    promote(registry, 2)
    assert league("note", "tictactoe@2", "[bold]entropy", "--actor", "ada").out == "tictactoe@2: [bold]entropy\n"
    document = league("versions", "tictactoe", "--json").json
    assert (document["league"], [version["version"] for version in document["versions"]]) == ("tictactoe", [1, 2, 3])
    assert [version["aliases"] for version in document["versions"]] == [[], ["champion"], []]
    assert {"rating", "interval", "games", "steps", "parent", "sha256", "created_at"} <= set(document["versions"][0])
    notes = [version["note"] for version in document["versions"]]
    assert [note and (note["text"], note["actor"]) for note in notes] == [None, ("[bold]entropy", "ada"), None]
    lines = league("versions", "tictactoe").out.splitlines()
    assert lines[0].split()[:3] == ["version", "aliases", "rating"]
    assert [line.split()[0] for line in lines[1:]] == ["3", "2", "1"]
    assert lines[2].endswith("[bold]entropy")
    lines = league("versions", "tictactoe", "--limit", "2").out.splitlines()
    assert [line.split()[0] for line in lines[1:3]] == ["3", "2"]
    assert lines[3] == "Older versions are not shown: --limit, now 2."
    document = league("versions", "tictactoe", "--limit", "1", "--json").json
    assert [version["version"] for version in document["versions"]] == [3]
    assert league("note", "tictactoe@2", "").out == "tictactoe@2: note cleared\n"
    assert registry.versions.get("tictactoe", 2).note is None


@on_both_databases
def test_ratings_of_a_server_are_the_same(league: League, registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those from before a change of the code are shown as such."""
    league("evaluate", "tictactoe", "--blocks", "4", "--workers", "0")
    computed = league("versions", "tictactoe", "--json").json
    assert all(version["rating"] is not None for version in computed["versions"])
    refresh(registry, "tictactoe")
    assert registry.snapshots.current("tictactoe", "leaderboard") is not None
    assert league("versions", "tictactoe", "--json").json == computed
    league("evaluate", "tictactoe", "--blocks", "8", "--workers", "0")
    assert registry.snapshots.current("tictactoe", "leaderboard") is None
    result = league("versions", "tictactoe", "--json")
    assert result.err == ""
    assert all(
        new["games"] > old["games"] for new, old in zip(result.json["versions"], computed["versions"], strict=True)
    )
    changed = registry.leagues.get("tictactoe").game | {"environment.source": "1" * 64}
    monkeypatch.setattr(LeagueConfig, "game", lambda self: changed)
    assert "→ 111111111111. These results are of the game before." in league("versions", "tictactoe").err


@on_both_databases
def test_text_of_others_is_escaped_and_invalid_unicode_rejected(league: League, registry: Registry) -> None:
    for arguments in (("note", "tictactoe@2", "a\udcff"), ("promote", "tictactoe@2", "--yes", "--reason", "a\udcff")):
        result = league(*arguments)
        assert (result.code, result.err.startswith("league: "), "is not valid text" in result.err) == (2, True, True)
    assert registry.aliases.current("tictactoe") == {}
    assert registry.versions.get("tictactoe", 2).note is None
    hostile = "\x1b]0;owned\x07 \x9b31m\r"
    outputs = [
        league("note", "tictactoe@2", hostile).out,
        league("promote", "tictactoe@2", "--yes", "--reason", hostile, "--actor", hostile).out,
        league("versions", "tictactoe").out,
        league("history", "tictactoe").out,
    ]
    for out in outputs:
        assert not set(out) & {"\x1b", "\x07", "\x9b", "\r"}, out
    assert all("�]0;owned�" in out for out in outputs[2:])


@on_both_databases
def test_promotions_rollbacks_and_their_history(league: League, registry: Registry) -> None:
    first = league("promote", "tictactoe@1", "--yes", "--reason", "the first")
    assert "now points to version 1 (before: nothing)" in first.out
    second = league("promote", "tictactoe@3", "--yes", "--actor", "ada")
    assert "now points to version 3 (before: version 1)" in second.out
    assert league("promote", "tictactoe@3", "--yes").out == "tictactoe@champion already points to version 3.\n"
    assert league("rollback", "tictactoe", "--json").json["version"] == 1
    events = league("history", "tictactoe", "--json").json["events"]
    changes = [(event["version"], event["previous"], event["kind"]) for event in events]
    assert changes == [(1, 3, "rollback"), (3, 1, "set"), (1, None, "set")]
    assert (events[1]["actor"], events[2]["reason"]) == ("ada", "the first")
    then = league("history", "tictactoe", "--at", events[1]["at"], "--json").json["events"]
    assert [event["version"] for event in then] == [3]
    moved = league("rollback", "tictactoe", "--expected", "3")
    assert moved.code == 1
    assert "is at tictactoe@1 now, expected tictactoe@3: nothing was changed" in moved.err
    nothing = league("rollback", "tictactoe", "--expected", "1")
    assert (nothing.code, nothing.err.startswith("league: ")) == (1, True)
    league("promote", "tictactoe@2", "--yes", "--alias", "candidate", "--expected", "none")
    assert registry.aliases.current("tictactoe") == {"champion": 1, "candidate": 2}


@on_both_databases
def test_a_version_that_never_played_or_was_rejected_needs_yes(league: League, registry: Registry) -> None:
    refused = league("promote", "tictactoe@1")
    assert refused.code == 2
    assert refused.err.startswith("league: tictactoe@1 has played no game under the current conditions")
    assert "confirm with --yes that tictactoe@1 shall be champion" in refused.err
    assert league("promote", "tictactoe@1", "--json").code == 2
    moved = league("promote", "tictactoe@1", "--expected", "2")
    assert "is not set, expected tictactoe@2" in moved.err, "what fails even with --yes is said at once"
    assert registry.aliases.current("tictactoe") == {}
    assert league("promote", "tictactoe@1", "--alias", "candidate").code == 0, "other aliases are not asked about"
    league("evaluate", "tictactoe", "--blocks", "2", "--workers", "0")
    assert league("promote", "tictactoe@1").code == 0
    verdict = open_verdict(registry, registry.leagues.get("tictactoe"), 2, "tictactoe@1")
    registry.verdicts.close(verdict.id, "reject", {"reason": "Not stronger: it scored 40.0 % against tictactoe@1."})
    refused = league("promote", "tictactoe@2")
    rejected = f"the gate has rejected tictactoe@2 in verdict {verdict.short_id}: Not stronger: it scored 40.0 %"
    assert (refused.code, rejected in refused.err) == (2, True)
    assert league("promote", "tictactoe@2", "--yes").code == 0
    assert league("promote", "tictactoe@2").code == 0, "it is champion already"


@on_both_databases
def test_of_two_concurrent_promotions_one_fails(league_process: League, registry: Registry) -> None:
    promote(registry, 1)
    with ThreadPoolExecutor(2) as pool:
        refs = ("tictactoe@2", "tictactoe@3")
        results = list(pool.map(lambda ref: league_process("promote", ref, "--yes", "--expected", "1"), refs))
    assert sorted(outcome.code for outcome in results) == [0, 1]
    loser = max(results, key=lambda outcome: outcome.code)
    assert loser.err.startswith("league: ")
    assert str(registry.aliases.current("tictactoe")["champion"]) in loser.err


REFS = ("tictactoe@1", "tictactoe@2", "tictactoe@3")


def test_a_mixture_is_promoted_shown_and_rolled_back(league: League, registry: Registry) -> None:
    promote(registry, 1)
    out = league("promote", "tictactoe@1:0.6,tictactoe@3:0.4", "--yes", "--to", "champion").out
    assert "tictactoe@champion now points to version 4 (before: version 1)." in out
    assert "mixture of @1 60.0 %, @3 40.0 %" in league("versions", "tictactoe").out
    assert "4 (@1 60.0 %, @3 40.0 %)" in league("history", "tictactoe").out
    event = league("history", "tictactoe", "--json").json["events"][0]
    assert (event["version"], [member["version"] for member in event["members"]]) == (4, [1, 3])
    assert league("promote", "tictactoe@3:0.4,@1:0.6", "--yes", "--json").json["id"] == event["id"], "nothing changes"
    assert league("act", "tictactoe@champion", "--local", "--json").json["version"] in (1, 3)
    assert league("rollback", "tictactoe", "--json").json["version"] == 1


def test_replicas_are_waited_for(league: League, registry: Registry) -> None:
    promote(registry, 1)
    mixed = ("promote", "tictactoe@1:0.6,tictactoe@3:0.4", "--yes", "--wait")
    with listening(registry.storage):
        assert "Confirmed by 1 replica." in league(*mixed).out
        assert "Confirmed by 1 replica." in league("rollback", "tictactoe", "--wait").out
    result = league(*mixed, "--timeout", "0")
    assert (result.code, "is a server running" in result.err) == (1, True)
    assert registry.versions.resolve("tictactoe@champion").mixture is not None


def test_the_equilibrium_becomes_an_alias(league: League, registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    result = league("mixture", "tictactoe")
    assert result.err.startswith("league: no two of the 3 versions have played each other: `league evaluate LEAGUE`")
    league("evaluate", "tictactoe", "--games", "60", "--workers", "0")
    out = league("mixture", "tictactoe").out
    assert out.splitlines()[0].split() == ["version", "probability", "score", "against", "it"]
    assert "Computed from" in out
    assert registry.aliases.current("tictactoe") == {}, "nothing is set without --alias"
    members = league("mixture", "tictactoe", "--method", "alpha_rank", "--json").json["members"]
    assert sum(members.values()) == pytest.approx(1)
    assert "confirm with --yes" in league("mixture", "tictactoe", "--alias", "mix").err
    out = league("mixture", "tictactoe", "--alias", "mix", "--method", "alpha_rank", "--at-least", "0", "--yes").out
    assert "tictactoe@mix now points to version" in out
    target = registry.versions.resolve("tictactoe@mix")
    assert target.mixture is None or set(target.mixture.versions) <= {1, 2, 3}
    alike = MetaStrategy(REFS, (1 / 3,) * 3, ((0.5,) * 3,) * 3, 60, 0)
    monkeypatch.setattr("league.results.payoffs.meta_strategy", lambda *_: alike)
    refused = league("mixture", "tictactoe", "--at-least", "0.4", "--alias", "mix", "--yes")
    assert refused.err == "league: --at-least 0.4: no version is as probable; the highest probability is 0.333\n"


def test_scores_are_those_against_the_mixture(
    league: League, registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The third version is left out: three of five opponents are the first version, the others the second."""
    payoff = ((0.5, 0.8, 0.2), (0.2, 0.5, 0.9), (0.8, 0.1, 0.5))
    strategy = MetaStrategy(REFS, (1 / 2, 1 / 3, 1 / 6), payoff, 60, 0)
    monkeypatch.setattr("league.results.payoffs.meta_strategy", lambda *_: strategy)
    lines = league("mixture", "tictactoe", "--at-least", "0.2").out.splitlines()[1:4]
    assert [line.split() for line in lines] == [
        ["tictactoe@1", "0.600", "0.620"],
        ["tictactoe@2", "0.400", "0.320"],
        ["tictactoe@3", "0.000", "0.520"],
    ]


def test_a_search_version_is_published_and_shown(league: League, registry: Registry) -> None:
    value = masked_mlp((3, 3, 2), 9, has_value=True)
    tictactoe.publish(registry, masked_mlp((3, 3, 2), 9), value=value)
    out = league("search", "tictactoe@4", "--simulations", "20", "--rule", "gumbel", "--note", "looks ahead").out
    assert out == "tictactoe@5 plays tictactoe@4 with a search of 20 simulations (gumbel)\n"
    listed = league("versions", "tictactoe", "--json").json["versions"][-1]
    assert (listed["role"], listed["note"]["text"]) == ("search", "looks ahead")
    assert {"version": 4, "rule": "gumbel", "simulations": 20}.items() <= listed["search"].items()
    assert "search with @4, 20 simulations, gumbel" in league("versions", "tictactoe").out
    again = league("search", "tictactoe@4", "--simulations", "20", "--rule", "gumbel", "--json").json
    assert again == {"league": "tictactoe", "version": 5, "search": listed["search"]}
    assert league("search", "tictactoe@1").err.startswith("league: tictactoe@1 has no value graph")


YEAR = timedelta(days=365)


@pytest.fixture
def old(registry: Registry) -> Registry:
    """Three versions that are a year old; the first is the champion."""
    promote(registry, 1)
    with registry.database.write() as session:
        session.execute(update(VersionTable).values(reserved_at=datetime.now(UTC) - YEAR))
    return registry


def test_old_versions_and_logs_are_removed_after_confirmation(league: League, old: Registry, home: Path) -> None:
    """The access logs are of a replica that ended a year ago, and of one that serves."""
    former, current = (home / "logs" / f"access-{name}.jsonl" for name in ("former", "serving"))
    former.parent.mkdir(parents=True)
    old.replicas.register("serving", {})
    for log in (former, current):
        log.write_text("{}\n")
        os.utime(log, (0, 0))
    result = league("retire", "--keep=1", "--dry-run", "--json")
    (plan,) = result.json["leagues"]
    assert (plan["versions"].keys(), result.json["logs"]) == ({"2"}, [str(former)])
    assert "Would remove 1 access log files" in league("retire", "--keep=1", "--dry-run").out
    asked = league("retire", "--keep=1")
    assert (asked.code, "--yes" in asked.err) == (2, True)
    assert former.exists()
    assert all(row.retired_at is None for row in old.versions.all(tictactoe.LEAGUE))
    result = league("retire", tictactoe.LEAGUE, "--keep=1", "--yes")
    assert result.code == 0, result.err
    rows = [line.split()[:2] for line in result.out.splitlines() if line.startswith("tictactoe")]
    assert rows == [["tictactoe", "2"]]
    assert (former.exists(), current.exists()) == (False, True)
    assert "retired" in league("versions", tictactoe.LEAGUE).out
    assert league("retire", "--keep=1", "--yes").out == "There is nothing to remove.\n"
    exported = league("export", f"{tictactoe.LEAGUE}@2")
    assert exported.code != 0
    assert "tictactoe@2 was retired and its files were removed" in exported.err


def test_a_league_of_another_release_stops_no_other(league: League, old: Registry) -> None:
    with old.database.write() as session:
        session.add(
            LeagueRow(
                slug="later", last_version=0, registered_at=datetime.now(UTC), archived_at=None,
                config_document={"of": "another release"}, interface_document={}, interface_digest="",
                environment_digest="", game={}, game_digest="",
            )
        )  # fmt: skip
    result = league("retire", "--keep=1", "--yes", "--json")
    assert result.code == 0, result.err
    assert {plan["league"]: list(plan["versions"]) for plan in result.json["leagues"]} == {
        tictactoe.LEAGUE: ["2"],
        "later": [],
    }


@pytest.fixture(autouse=True)
def few_observations(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "IMPORTED", replace(checks.IMPORTED, observations=300))


def test_an_imported_model_can_be_promoted(league: League, registry: Registry, tmp_path: Path) -> None:
    path = tmp_path / "foreign.onnx"
    path.write_bytes(foreign(18, 9, shape=(3, 3, 2)))
    result = league("import", "tictactoe", str(path), "--note", "made elsewhere")
    assert "tictactoe@4 is published" in result.out
    assert "0 of 3" in result.out
    assert registry.versions.get("tictactoe", 4).note.text == "made elsewhere"
    assert league("promote", "tictactoe@4", "--yes").code == 0


def test_an_exported_version_can_be_imported(league: League, registry: Registry, tmp_path: Path) -> None:
    """Also from a folder for the hub, which is new or empty, and complete or not written."""
    out, folder = tmp_path / "exported", tmp_path / "new" / "folder"
    assert league("export", "tictactoe@3", str(out)).code == 0
    manifest = json.loads((out / "manifest.json").read_text())
    assert {policy["file"] for policy in manifest["policies"].values()} <= {file.name for file in out.iterdir()}
    OnnxPolicy(out / "shared.onnx")
    assert league("import", "tictactoe", str(out)).code == 0
    load("tictactoe@4", registry=registry)
    result = league("export", "tictactoe@3", "--hub", str(folder))
    assert (result.code, f"{folder / CARD}\n" in result.out) == (0, True)
    assert sorted(path.name for path in folder.iterdir()) == [CARD, "manifest.json", "shared.onnx"]
    assert [path.name for path in folder.parent.iterdir()] == ["folder"]
    assert league("import", "tictactoe", str(folder)).code == 0
    (folder / CARD).write_text("mine")
    result = league("export", "tictactoe@3", str(folder), "--hub")
    assert (result.code, f"{folder}: expected a new or empty folder" in result.err) == (2, True)
    assert league("export", "tictactoe@3", str(folder / CARD), "--hub").code == 2
    assert (folder / CARD).read_text() == "mine"
    (empty := tmp_path / "empty").mkdir()
    assert league("export", "tictactoe@3", str(empty), "--hub").code == 0
    (registry.artifacts.path("tictactoe", 3) / "shared.onnx").write_bytes(b"damaged")
    result = league("export", "tictactoe@3", str(tmp_path / "damaged"), "--hub")
    assert (result.code != 0, "shared.onnx was changed" in result.err) == (True, True)
    assert not (tmp_path / "damaged").exists()


@pytest.mark.usefixtures("registry")
def test_formats_that_run_code_require_trust(league: League, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("shared.zip", "shared.pt2"):
        (tmp_path / name).write_bytes(b"anything")
    for options in (["--rllib"], ["--sb3"], []):
        result = league("import", "tictactoe", str(tmp_path), *options)
        assert result.code == 2
        assert "runs code from it: add --trust if you trust its author" in result.err
    monkeypatch.setitem(sys.modules, "mlflow", None)
    result = league("export", "tictactoe@3", "--mlflow")
    assert (result.code, "pip install 'policy-league[mlflow]'" in result.err) == (2, True)


@pytest.mark.slow
def test_a_model_of_mlflow_acts(
    league: League, registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mlflow = pytest.importorskip("mlflow", reason="pip install mlflow-skinny")
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    store = f"file:{tmp_path / 'mlruns'}"
    assert league("export", "tictactoe@3", "--mlflow", store).out == "models:/tictactoe/1\n"
    assert league("export", "tictactoe@3", store, "--mlflow").out == "models:/tictactoe/2\n"
    mlflow.set_tracking_uri(store)
    model = mlflow.pyfunc.load_model("models:/tictactoe/2")
    inputs = {"observation": np.zeros((1, 3, 3, 2), np.int8), "action_mask": np.eye(9, dtype=np.int8)[[5]]}
    assert model.predict(inputs)["action"].tolist() == [5]
    client = mlflow.MlflowClient()
    entry = client.get_model_version("tictactoe", "2")
    assert entry.tags["sha256"] == registry.versions.get("tictactoe", 3).sha256
    assert {file.path for file in client.list_artifacts(entry.run_id)} >= {CARD, "manifest.json"}


@pytest.mark.slow
def test_an_mlflow_that_does_not_answer(league: League, registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mlflow", reason="pip install mlflow-skinny")
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
    result = league("export", "tictactoe@3", "http://127.0.0.1:9", "--mlflow")
    assert "MLflow at http://127.0.0.1:9: MlflowException" in result.err
    assert result.code == 1
