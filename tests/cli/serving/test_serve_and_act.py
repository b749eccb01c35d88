import json
from contextlib import closing
from functools import partial
from pathlib import Path

import pytest

from league.registry.registry import Registry
from league.settings import Storage
from policy_league.cli.serving.serve import hints
from policy_league_client import Client
from tests.support.command import League
from tests.support.leagues import tictactoe
from tests.support.policies.graphs import masked_mlp

EMPTY = {"observation": [[[0, 0]] * 3] * 3, "action_mask": [1] * 9}


def test_act_locally_on_the_first_observation_of_an_episode(league: League, registry: Registry) -> None:
    assert league("act", "tictactoe@3", "--local").out.strip() == "1"


def test_without_a_version_the_champion_acts(league: League, registry: Registry) -> None:
    """As over HTTP."""
    registry.aliases.set("tictactoe", "champion", 3, expected=None, actor="ann", reason="best")
    for name in ("tictactoe", "tictactoe.shared"):
        assert league("act", name, "--local", "--json").json["version"] == 3


def test_act_locally_on_text_a_file_and_stdin(league: League, registry: Registry, tmp_path) -> None:
    corner = EMPTY | {"action_mask": [1, 0, 0, 0, 0, 0, 0, 0, 0]}
    path = tmp_path / "observation.json"
    path.write_text(json.dumps(corner))
    for source, stdin in ((json.dumps(corner), None), (str(path), None), ("-", json.dumps(corner))):
        document = league("act", "tictactoe@3", "--local", "--json", "-o", source, stdin=stdin).json
        assert document["action"] == 0
        assert document["version"] == 3
        assert document["sha256"] == registry.versions.get("tictactoe", 3).sha256


def test_a_server_that_does_not_answer(league: League, registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("policy_league_client.Client", partial(Client, retry_deadline=0.5))
    result = league("act", "tictactoe@3", "--url", "http://127.0.0.1:9", "-o", json.dumps(EMPTY))
    assert (result.code, result.err.count("\n")) == (1, 1)
    assert "http://127.0.0.1:9/v1/policies/tictactoe/action?version=3 cannot be reached: " in result.err
    assert "`league serve` starts a server, --url names another, --local needs none" in result.err


def test_a_search_version_acts_locally_and_explains_itself(league: League, registry: Registry) -> None:
    value = masked_mlp((3, 3, 2), 9, has_value=True)
    base = tictactoe.publish(registry, masked_mlp((3, 3, 2), 9), value=value)
    version = league("search", base.ref, "--simulations", "300", "--json").json["version"]
    ref, position = f"tictactoe@{version}", ("-o", json.dumps(EMPTY))
    document = league("act", ref, "--local", *position, "--analysis").json
    assert document["simulations"] == sum(document["analysis"]["visits"]) == 300
    assert document["action"] == document["analysis"]["line"][0]
    assert league("act", ref, "--local", *position, "--deadline-ms", "60000").out.strip() == str(document["action"])
    assert league("act", ref, "--local", *position, "--deadline-ms", "1", "--json").json["simulations"] < 300
    refused = league("act", base.ref, "--local", *position, "--analysis")
    assert (refused.code, refused.err) == (2, f"league: --analysis: {base.ref} does not search\n")


def test_exploration_with_a_seed_is_reproducible(league: League, registry: Registry) -> None:
    first = league("act", "tictactoe@1", "--local", "--explore", "--seed", "5").out
    assert first == league("act", "tictactoe@1", "--local", "--explore", "--seed", "5").out


def test_the_hints_name_a_league_of_the_user(registry: Registry) -> None:
    registry.aliases.set("tictactoe", "champion", 3, expected=None, actor="ann", reason="best")
    shown = hints(registry, "http://127.0.0.1:8000").splitlines()
    assert shown[-1] == "Try: league act tictactoe@champion"
    assert any(line.split()[0] == "http://127.0.0.1:8000/v1/policies/tictactoe/action" for line in shown)
    assert hints(registry, "http://10.0.0.1:9").endswith("tictactoe@champion --url http://10.0.0.1:9")


def test_the_hints_of_a_server_on_all_interfaces_can_be_used_here(registry: Registry) -> None:
    registry.aliases.set("tictactoe", "champion", 3, expected=None, actor="ann", reason="best")
    shown = hints(registry, "http://0.0.0.0:9")
    assert "0.0.0.0" not in shown
    assert shown.endswith("--url http://127.0.0.1:9")


def test_the_hints_name_the_league_that_was_promoted_last(registry: Registry, home: Path) -> None:
    row = registry.leagues.get("tictactoe")
    registry.leagues.register(row.config.model_copy(update={"league": "a_newer_one"}), row.interface)
    tictactoe.publish(registry, tictactoe.graph(), league="a_newer_one")
    for league in ("a_newer_one", "tictactoe"):
        registry.aliases.set(league, "champion", 1, expected=None, actor="ann", reason="best")
    assert hints(registry, "http://127.0.0.1:8000").endswith("league act tictactoe@champion")


def test_without_a_champion_the_first_step_is_training(tmp_path: Path) -> None:
    with closing(Registry.open(Storage.at(tmp_path))) as empty:
        assert "league train CONFIG, then league nightly" in hints(empty, "http://127.0.0.1:8000")
