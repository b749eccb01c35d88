"""`league act`, `keys`, `replicas` and `traffic`, and the hints of `league serve`."""

import json
from contextlib import closing
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path

import pytest
from sqlalchemy import update

from league.registry.registry import Registry
from league.registry.replicas import URL
from league.registry.storage.database import clock
from league.registry.storage.rows import Portion
from league.registry.storage.tables import ReplicaTable
from league.settings import Storage
from policy_league.cli.serving.serve import hints
from policy_league_client import Client
from tests.support.command import League
from tests.support.databases import on_both_databases
from tests.support.leagues import tictactoe
from tests.support.leagues.judged_league import promote
from tests.support.policies.graphs import masked_mlp


@on_both_databases
def test_a_key_is_shown_once_listed_and_revoked(league: League, registry: Registry) -> None:
    assert "No API keys" in league("keys", "list").out
    options = ("--scope", "act", "--scope", "read", "--rate", "600/m", "--expires", "30d")
    created = league("keys", "create", "lobby", *options)
    (token,) = created.out.splitlines()
    assert token.startswith("plk_")
    assert "it is not shown again" in created.err
    assert "require a key for every request" in created.err
    (key,) = league("keys", "list", "--json").json["keys"]
    assert (key["name"], key["scopes"], key["rate"], key["state"]) == ("lobby", ["act", "read"], 10, "valid")
    ends_in = datetime.fromisoformat(key["expires_at"]) - datetime.now(UTC)
    assert timedelta(days=29) < ends_in <= timedelta(days=30)
    assert token not in league("keys", "list").out
    assert token.encode() not in b"".join(path.read_bytes() for path in registry.storage.home.glob("league.db*"))
    assert "No valid key is left" in league("keys", "revoke", "lobby").out
    assert league("keys", "list", "--json").json["keys"][0]["state"] == "revoked"
    document = league("keys", "create", "duo", "--scope", "promote", "--league", "tictactoe", "--json").json
    assert document["key"].startswith("plk_")
    assert (document["leagues"], document["expires_at"], document["rate"]) == (["tictactoe"], None, None)
    assert "sha256" not in document


@on_both_databases
def test_replicas_are_listed_with_their_state_and_silent_ones_removed(league: League, registry: Registry) -> None:
    """One that reports, and one that has not done so for an hour."""
    registry.replicas.register("alive", {URL: "http://127.0.0.1:30001"})
    registry.replicas.register("silent", {})
    with registry.database.write() as session:
        seen_at = clock(session) - timedelta(hours=1)
        session.execute(update(ReplicaTable).filter_by(replica="silent").values(seen_at=seen_at))
    out = league("replicas").out
    assert [line.split()[0] for line in out.splitlines() if "reports" in line] == ["alive"]
    assert [line.split()[0] for line in out.splitlines() if "silent" in line] == ["silent"]
    assert "http://127.0.0.1:30001" in out
    first, second = league("replicas", "--json").json["replicas"]
    assert (first["replica"], first["silent"], first["url"]) == ("alive", False, "http://127.0.0.1:30001")
    assert (second["replica"], second["silent"], second["url"]) == ("silent", True, None)
    assert second["silent_seconds"] == pytest.approx(3600, abs=60)
    for replica, message in (("alive", "stop it instead"), ("other", "no replica 'other'; known: alive, silent")):
        result = league("replicas", "--remove", replica)
        assert (result.code != 0, message in result.err) == (True, True)
    assert league("replicas", "--remove", "silent").out == "Removed replica silent.\n"
    assert [row.replica for row in registry.replicas.registered()] == ["alive"]


@on_both_databases
def test_canary_and_shadow_are_set_shown_and_ended(league: League, registry: Registry) -> None:
    assert "the champion serves all requests" in league("traffic", "tictactoe").out
    league("promote", "tictactoe@2", "--yes", "--alias", "candidate")
    canary = "tictactoe@candidate is the canary for 5.0% of the routing keys"
    assert canary in league("traffic", "tictactoe", "--canary", "candidate").out
    out = league("traffic", "tictactoe", "--shadow", "tictactoe@3", "--shadow-share", "0.5", "--actor", "ada").out
    assert canary in out
    assert "tictactoe@3 is the shadow for 50.0% of the requests" in out
    document = league("traffic", "tictactoe", "--share", "0.2", "--json").json
    assert document["canary"] == {"version": "candidate", "share": 0.2}
    assert league("traffic", "tictactoe", "--json").json["shadows"] == []
    league("traffic", "tictactoe", "--canary", "none")
    split = registry.traffic.current("tictactoe")
    assert (split.canary, split.shadow) == (None, Portion(3, 0.5))
    assert "the champion serves all requests" in league("traffic", "tictactoe", "--off").out
    result = league("traffic", "tictactoe", "--canary", "3", "--wait", "--timeout", "0")
    assert (result.code, "is a server running" in result.err) == (1, True)
    promote(registry, 1)
    refused = league("traffic", "tictactoe", "--shadow", "champion")
    assert (refused.code, "must be another version" in refused.err) == (2, True)


EMPTY = {"observation": [[[0, 0]] * 3] * 3, "action_mask": [1] * 9}


def test_act_locally_on_text_a_file_and_stdin(league: League, registry: Registry, tmp_path: Path) -> None:
    """Without a version the champion acts, as over HTTP. Exploration with a seed is reproducible."""
    assert league("act", "tictactoe@3", "--local").out.strip() == "1"
    corner = json.dumps(EMPTY | {"action_mask": [1, 0, 0, 0, 0, 0, 0, 0, 0]})
    path = tmp_path / "observation.json"
    path.write_text(corner)
    sha256 = registry.versions.get("tictactoe", 3).sha256
    for source, stdin in ((corner, None), (str(path), None), ("-", corner)):
        document = league("act", "tictactoe@3", "--local", "--json", "-o", source, stdin=stdin).json
        assert (document["action"], document["version"], document["sha256"]) == (0, 3, sha256)
    promote(registry, 3)
    for name in ("tictactoe", "tictactoe.shared"):
        assert league("act", name, "--local", "--json").json["version"] == 3
    explored = [league("act", "tictactoe@1", "--local", "--explore", "--seed", "5").out for _ in range(2)]
    assert explored[0] == explored[1]


def test_a_server_that_does_not_answer(league: League, registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("policy_league_client.Client", partial(Client, retry_deadline=0.5))
    result = league("act", "tictactoe@3", "--url", "http://127.0.0.1:9", "-o", json.dumps(EMPTY))
    assert (result.code, result.err.count("\n")) == (1, 1)
    assert "http://127.0.0.1:9/v1/policies/tictactoe/action?version=3 cannot be reached: " in result.err
    assert "`league serve` starts a server, --url names another, --local needs none" in result.err


def test_a_server_of_another_machine_needs_an_observation(league: League, home: Path) -> None:
    result = league("act", "tictactoe", "--url", "http://policies.example:8000")
    assert (result.code, result.err.count("\n")) == (2, 1)
    assert result.err.startswith("league: pass --observation: the first one of an episode can be computed only where")
    assert not home.exists()


def test_a_search_version_acts_locally_and_explains_itself(league: League, registry: Registry) -> None:
    value = masked_mlp((3, 3, 2), 9, has_value=True)
    base = tictactoe.publish(registry, masked_mlp((3, 3, 2), 9), value=value)
    version = league("search", base.ref, "--simulations", "300", "--json").json["version"]
    command = ("act", f"tictactoe@{version}", "--local", "-o", json.dumps(EMPTY))
    document = league(*command, "--analysis").json
    assert document["simulations"] == sum(document["analysis"]["visits"]) == 300
    assert document["action"] == document["analysis"]["line"][0]
    assert league(*command, "--deadline-ms", "60000").out.strip() == str(document["action"])
    assert league(*command, "--deadline-ms", "1", "--json").json["simulations"] < 300


def test_the_hints_of_a_server_name_the_league_that_was_promoted_last(registry: Registry, tmp_path: Path) -> None:
    """Without a champion, the first step is training."""
    row = registry.leagues.get("tictactoe")
    registry.leagues.register(row.config.model_copy(update={"league": "a_newer_one"}), row.interface)
    tictactoe.publish(registry, tictactoe.graph(), league="a_newer_one")
    for league in ("a_newer_one", "tictactoe"):
        registry.aliases.set(league, "champion", 1, expected=None, actor="ann", reason="best")
    lines = hints(registry, "http://127.0.0.1:8000").splitlines()
    assert lines[-1] == "Try: league act tictactoe@champion"
    assert any(line.split()[0] == "http://127.0.0.1:8000/v1/policies/tictactoe/action" for line in lines)
    assert hints(registry, "http://10.0.0.1:9").endswith("tictactoe@champion --url http://10.0.0.1:9")
    on_all_interfaces = hints(registry, "http://0.0.0.0:9")
    assert "0.0.0.0" not in on_all_interfaces
    assert on_all_interfaces.endswith("--url http://127.0.0.1:9")
    assert hints(registry, "http://[::]:9").endswith("--url http://[::1]:9")
    with closing(Registry.open(Storage.at(tmp_path / "empty"))) as empty:
        assert "league train CONFIG, then league nightly" in hints(empty, "http://127.0.0.1:8000")
