import json
from contextlib import closing
from pathlib import Path

from cli.serving import first_call
from league.registry.registry import Registry
from league.settings import Storage
from tests.support.command import League

EMPTY = {"observation": [[[0, 0]] * 3] * 3, "action_mask": [1] * 9}


def test_act_locally_on_the_first_observation_of_an_episode(league: League, registry: Registry) -> None:
    assert league("act", "tictactoe@3", "--local").out.strip() == "1"


def test_act_locally_on_text_a_file_and_stdin(league: League, registry: Registry, tmp_path) -> None:
    corner = EMPTY | {"action_mask": [1, 0, 0, 0, 0, 0, 0, 0, 0]}
    path = tmp_path / "observation.json"
    path.write_text(json.dumps(corner))
    for source, stdin in ((json.dumps(corner), None), (str(path), None), ("-", json.dumps(corner))):
        document = league("act", "tictactoe@3", "--local", "--json", "-o", source, stdin=stdin).json
        assert document["action"] == 0
        assert document["version"] == 3
        assert document["sha256"] == registry.versions.get("tictactoe", 3).sha256


def test_exploration_with_a_seed_is_reproducible(league: League, registry: Registry) -> None:
    first = league("act", "tictactoe@1", "--local", "--explore", "--seed", "5").out
    assert first == league("act", "tictactoe@1", "--local", "--explore", "--seed", "5").out


def test_the_first_call_names_a_league_of_the_user(registry: Registry) -> None:
    registry.aliases.set("tictactoe", "champion", 3, expected=None, actor="ann", reason="best")
    assert first_call(registry, "http://127.0.0.1:8000") == "Try: league act tictactoe@champion"
    assert first_call(registry, "http://10.0.0.1:9").endswith("tictactoe@champion --url http://10.0.0.1:9")


def test_without_a_champion_the_first_step_is_training(tmp_path: Path) -> None:
    with closing(Registry.open(Storage.at(tmp_path))) as empty:
        assert "league train CONFIG, then league nightly" in first_call(empty, "http://127.0.0.1:8000")
