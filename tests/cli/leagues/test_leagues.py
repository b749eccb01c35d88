"""`league compare`, `init`, `list`, `archive` and `remove`."""

from pathlib import Path

import pytest
import yaml

from league.config.league import LeagueConfig
from league.registry.registry import Registry
from league.registry.storage.rows import RunPoint
from policy_league.cli import output
from tests.support.command import League
from tests.support.leagues import tictactoe
from tests.support.leagues.judged_league import promote

RUNS = ("20261124-080000-aa12bc", "20261125-080000-de34f5")


@pytest.fixture
def runs(registry: Registry) -> tuple[str, str]:
    for run, lr in zip(RUNS, (0.001, 0.0005), strict=True):
        registry.runs.begin(NAME, run, algorithm="ppo", settings={"lr": lr, "gamma": 0.99}, seed=1, target=9000)
        metrics = {"shared/return": lr, "opponents/script:nim_bot:act/score": 0.5}
        point = RunPoint(NAME, run, 600_000, metrics, registry.runs.get(NAME, run).began_at)
        registry.runs.record(NAME, run, point, seconds=120.0)
    return RUNS


@pytest.mark.usefixtures("runs")
def test_runs_are_compared_by_short_ids(league: League, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(output.console, "width", 80)
    out = league("compare", "20261124", "20261125").out
    rows = {line.split()[0]: line.split()[1:] for line in out.splitlines() if line.strip()}
    assert rows["run"] == list(RUNS)
    assert out.count("shared/return") == out.count("opponents/") == 1, "both runs are side by side"
    assert rows["lr"] == ["0.001", "0.0005"]
    assert rows["actions"] == ["600,000", "600,000"]
    assert rows["actions/s"] == ["5,000", "5,000"]
    assert rows["shared/return"] == ["0.001", "0.0005"]
    assert "gamma" not in rows
    assert max(map(len, out.splitlines())) <= 80
    document = league("compare", *RUNS, "--json").json
    assert document["settings"] == {"lr": [0.001, 0.0005]}
    assert [run["run"] for run in document["runs"]] == list(RUNS)


def test_versions_that_never_played_each_other_are_named(
    league: League, registry: Registry, runs: tuple[str, str]
) -> None:
    first, second = (tictactoe.publish(registry, tictactoe.graph(), source=f"{run}/checkpoint").ref for run in runs)
    out = " ".join(league("compare", *runs).out.split())
    assert f"have not played each other: league evaluate tictactoe {first} {second}" in out
    for name, message in (
        ("2026", "is ambiguous"),
        ("chess/1", "there is no training run 'chess/1'"),
        ("x", RUNS[1]),
        ("20261124", f"are the same run, tictactoe/{RUNS[0]}"),
    ):
        result = league("compare", RUNS[0], name)
        assert (result.code, result.err.count("\n"), message in result.err) == (2, 1, True), result.err


TICTACTOE = "pettingzoo.classic.tictactoe_v3"


BROKEN = """
from policy_league.examples.two_step import TwoStep


def make_env(fault=True):
    env = TwoStep()
    if fault:
        env.step = lambda actions: 1 / 0
    return env
"""


@pytest.fixture
def directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, short_examinations: None) -> Path:
    """The working directory, for `league init`."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.usefixtures("directory")
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


@pytest.mark.usefixtures("directory")
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


@pytest.mark.usefixtures("directory")
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


@pytest.mark.usefixtures("directory")
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


NAME = tictactoe.LEAGUE


def test_without_a_league_the_next_step_is_named(league: League) -> None:
    assert "league init" in league("list").out
    assert league("list", "--json").json == {"leagues": []}


def test_leagues_are_listed_with_their_last_verdict(league: League, registry: Registry) -> None:
    verdict = f"{NAME}-verdict-0f3a62d1c8b45e97-1b2c3d4e"
    registry.verdicts.open(NAME, 2, "script:random", verdict, {})
    registry.verdicts.close(verdict, "promote", {"promoted": True})
    registry.aliases.set(NAME, "champion", 2, expected=None, actor="me", reason="")
    registry.nightly_runs.close(registry.nightly_runs.open(NAME, [2], 0.05).id, {})
    (document,) = league("list", "--json").json["leagues"]
    assert (document["league"], document["versions"], document["champion"]) == (NAME, 3, 2)
    assert (document["last_verdict"]["verdict"], document["last_verdict"]["outcome"]) == (verdict, "promote")
    assert document["last_night"] is not None
    assert document["archived_at"] is None
    header, row = league("list").out.splitlines()
    assert "state" not in header
    assert row.split()[:5] == [NAME, "3", "@2", "0f3a62d1", "promote"]


@pytest.mark.usefixtures("ray_session")  # `league train` starts a Ray otherwise
def test_an_archived_league_is_skipped_and_not_extended(league: League, registry: Registry, tmp_path: Path) -> None:
    assert league("archive", NAME).out == f"{NAME} is archived.\n"
    assert league("list").out.splitlines()[1].endswith("archived")
    hint = f"league {NAME} is archived: `league archive {NAME} --undo` makes it active again"
    path = tmp_path / "tictactoe.yaml"
    path.write_text(yaml.safe_dump(tictactoe.config().model_dump(mode="json", by_alias=True)))
    for names in ((), (NAME,), (str(path),), (NAME, "--train")):
        skipped = league("nightly", "--workers", "0", *names)
        assert (skipped.code, skipped.out, skipped.err) == (0, "", f"skipped: {hint}\n")
    refused = league("train", str(path))
    assert (refused.code, refused.err) == (1, f"league: {hint}\n")
    assert league("versions", NAME).code == 0
    assert league("archive", NAME, "--undo", "--json").json == {"league": NAME, "archived_at": None}
    assert not league("list").out.splitlines()[1].endswith("archived")


def test_a_league_is_not_archived_during_training(league: League, registry: Registry) -> None:
    registry.runs.begin(NAME, "active", algorithm="ppo", settings={}, seed=0, target=10)
    refused = league("archive", NAME)
    assert (refused.code, "training run active of league tictactoe is active" in refused.err) == (1, True)
    assert league("archive", "chess").code == 2


def test_a_version_is_removed_after_confirmation(league: League, registry: Registry) -> None:
    """The champion by force only, and nothing during a nightly run."""
    with registry.exclusive_lock(f"nightly-{NAME}"):
        refused = league("remove", "tictactoe@2", "--yes")
    assert (refused.code, "another process is running nightly-tictactoe" in refused.err) == (1, True)
    asked = league("remove", "tictactoe@2")
    assert (asked.code, "--yes" in asked.err) == (2, True)
    plan = league("remove", "tictactoe@2", "--dry-run", "--json").json
    assert (plan["dry_run"], plan["target"], list(plan["versions"])) == (True, "tictactoe@2", ["2"])
    assert len(registry.versions.all(NAME)) == 3
    removed = league("remove", "tictactoe@2", "--yes")
    assert (removed.code, removed.out.endswith("Removed tictactoe@2.\n")) == (0, True), removed.err
    assert [row.number for row in registry.versions.all(NAME)] == [1, 3]
    assert not registry.artifacts.path(NAME, 2).exists()
    assert league("remove", "tictactoe@2", "--yes").code == 2
    promote(registry, 1)
    refused = league("remove", "tictactoe@champion", "--yes")
    assert refused.code == 1
    assert "tictactoe@1 is in use: the alias champion points to it" in refused.err
    assert "--force" in refused.err
    assert league("remove", "tictactoe@1", "--dry-run").code == 0
    assert registry.aliases.current(NAME) == {"champion": 1}
    assert league("remove", "tictactoe@champion", "--yes", "--force").code == 0
    assert registry.aliases.current(NAME) == {}


def test_a_league_is_removed_with_its_report_and_runs(league: League, registry: Registry) -> None:
    report = promote(registry, 1).storage.home / "reports" / f"{NAME}.html"
    report.parent.mkdir()
    report.write_text("a report")
    refused = league("remove", NAME, "--yes")
    assert (refused.code, "tictactoe is in use: the alias champion is set" in refused.err) == (1, True)
    removed = league("remove", NAME, "--yes", "--force")
    assert (removed.code, "tictactoe: 3 versions, " in removed.out) == (0, True), removed.err
    assert registry.leagues.names() == {}
    assert not report.exists()
    assert league("remove", NAME, "--yes").code == 2
