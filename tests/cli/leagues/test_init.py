"""`league init`: a commented configuration that passes `league check-env`."""

from pathlib import Path

import pytest
import yaml

from league.config.league import LeagueConfig
from tests.support.command import League

pytestmark = pytest.mark.usefixtures("short_examinations")

TICTACTOE = "pettingzoo.classic.tictactoe_v3"
BROKEN = """
from policy_league.examples.two_step import TwoStep


def make_env(fault=True):
    env = TwoStep()
    if fault:
        env.step = lambda actions: 1 / 0
    return env
"""


@pytest.fixture(autouse=True)
def _directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_the_file_passes_check_env_and_is_not_overwritten(league: League) -> None:
    written = league("init", TICTACTOE)
    assert written.code == 0, written.err
    assert "play.opening_plies: 2 is recommended" in written.out
    assert written.out.endswith("Wrote tictactoe.yaml. Next: league train tictactoe.yaml\n")
    text = Path("tictactoe.yaml").read_text()
    assert all("  # " in line for line in text.splitlines()[1:] if line)
    config = LeagueConfig.load("tictactoe.yaml")
    assert (config.league, config.play.opening_plies, config.play.actions) == ("tictactoe", 2, "greedy")
    assert (config.policies, config.training.algorithm) == ({"shared": ("*",)}, "ppo")
    checked = league("check-env", "tictactoe.yaml")
    assert (checked.code, "The environment passes all checks." in checked.out) == (0, True), checked.out
    again = league("init", TICTACTOE)
    assert (again.code, again.err.count("\n")) == (2, 1)
    assert "tictactoe.yaml exists and is not overwritten" in again.err
    assert Path("tictactoe.yaml").read_text() == text


def test_code_in_the_working_directory_is_found_from_another_folder(league: League) -> None:
    Path("mine_for_init.py").write_text(BROKEN)
    Path("leagues").mkdir()
    written = league(
        "init", "mine_for_init:make_env", "--arg", "fault=false", "--output", "leagues/a.yaml", "--name", "mine"
    )
    assert written.code == 0, written.err
    document = yaml.safe_load(Path("leagues/a.yaml").read_text())
    assert (document["league"], document["folder"]) == ("mine", "..")
    assert document["environment"] == {"entry_point": "mine_for_init:make_env", "kwargs": {"fault": False}}
    assert document["sides"] == {"team": ["*"]}, "both agents get the same reward"
    LeagueConfig.load("leagues/a.yaml")


def test_a_team_is_one_side_unless_the_user_says_otherwise(league: League) -> None:
    for options, sides in ((), {"team": ["*"]}), (("--no-team",), {f"agent_{i}": [f"agent_{i}"] for i in range(2)}):
        written = league(
            "init", "policy_league.examples.two_step:parallel_env", "--output", f"game{len(options)}.yaml", *options
        )
        assert written.code == 0, written.err
        assert "are they one team?" in written.out
        assert ("If they are opponents, use --no-team." in written.out) == (not options)
        assert yaml.safe_load(Path(f"game{len(options)}.yaml").read_text())["sides"] == sides
    assert league("init", TICTACTOE, "--team").code == 0
    assert yaml.safe_load(Path("tictactoe.yaml").read_text())["sides"] == {"team": ["*"]}


def test_without_a_usable_environment_nothing_is_written(league: League) -> None:
    Path("broken_for_init.py").write_text(BROKEN)
    for arguments, message in (
        (("broken_for_init:make_env",), "ZeroDivisionError"),
        (("broken_for_init:nothing",), "has no 'nothing'"),
        (("nowhere_for_init:make_env",), "cannot import 'nowhere_for_init'"),
        (("broken_for_init:make_env", "--arg", "fault"), "expected NAME=VALUE"),
        (("broken_for_init:make_env", "--name", "A B"), "'A B' must consist of"),
        (("broken_for_init:make_env", "--output", "missing/a.yaml"), "is not a directory"),
    ):
        result = league("init", *arguments)
        assert (result.code, result.err.count("\n")) == (2, 1), result.err
        assert message in result.err
    assert not list(Path().glob("*.yaml"))
