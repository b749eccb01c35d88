import os
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml
from pettingzoo.classic.tictactoe import tictactoe as tictactoe_v3
from sqlalchemy import select

from league.registry.registry import Registry
from league.registry.storage.rows import VerdictRow
from league.registry.storage.tables import MatchTable
from tests.support.command import COMMAND, League, environment
from tests.support.leagues import tictactoe
from tests.support.waiting import until


@pytest.fixture
def config(tmp_path: Path) -> str:
    path = tmp_path / "tictactoe.yaml"
    path.write_text(yaml.safe_dump(tictactoe.config().model_dump(mode="json", by_alias=True)))
    return str(path)


def test_evaluate_as_json(league: League, registry: Registry) -> None:
    document = league("evaluate", "tictactoe", "--blocks", "20", "--workers", "0", "--json").json
    leaderboard = {standing["ref"]: standing for standing in document["leaderboard"]}
    assert set(leaderboard) == {"tictactoe@1", "tictactoe@2", "tictactoe@3", "script:random", "script:one_ply"}
    assert leaderboard["script:random"]["rating"] == 0
    for standing in leaderboard.values():
        assert {"mean_return", "score", "rating", "interval", "games"} <= set(standing)
        low, high = standing["interval"]
        assert low <= standing["rating"] <= high
    assert leaderboard["tictactoe@3"]["rating"] > leaderboard["tictactoe@1"]["rating"]


def test_evaluate_as_tables(league: League, registry: Registry) -> None:
    out = league("evaluate", "tictactoe", "tictactoe@1", "tictactoe@3", "--blocks", "4", "--workers", "0").out
    assert "tictactoe@3" in out
    assert "script:one_ply" in out


def test_evaluate_within_a_budget(league: League, registry: Registry) -> None:
    options = ("--schedule", "adaptive", "--games", "41", "--workers", "0")
    assert "40 games" in (out := league("evaluate", "tictactoe", *options).out)
    assert "stopped by --games" in out
    document = league("evaluate", "tictactoe", *options, "--json").json
    assert (document["kind"], document["stopped_by"], document["games"]) == ("adaptive", "games", 40)
    assert document["population"] is None


def test_evaluate_reports_shares_of_a_complete_table(league: League, registry: Registry) -> None:
    result = league("evaluate", "tictactoe", "--blocks", "4", "--workers", "0")
    assert "α-Rank" in result.out
    population = league("evaluate", "tictactoe", "--blocks", "4", "--workers", "0", "--json").json["population"]
    for shares in population.values():
        assert sum(share["value"] for share in shares) == pytest.approx(1)
        assert all(share["low"] <= share["high"] for share in shares)


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


def test_nightly_tests_promotes_and_rates_and_the_next_run_has_nothing_to_do(
    league: League, registry: Registry, config: str
) -> None:
    result = league("nightly", config, "--workers", "0")
    assert result.code == 0, result.err
    assert "tictactoe@1 against script:random" in result.out
    champion = registry.aliases.current("tictactoe")["champion"]
    assert f"the champion is now tictactoe@{champion}" in result.out
    again = league("nightly", config, "--workers", "0", "--json").json["leagues"][0]
    assert again["verdicts"] == []
    assert again["champion"] == f"tictactoe@{champion}"
    rated = league("versions", "tictactoe", "--json").json["versions"]
    assert all(version["rating"] is not None for version in rated)


def test_a_verdict_is_verified_and_a_modified_one_fails(league: League, registry: Registry, config: str) -> None:
    verdict = league("nightly", config, "--workers", "0", "--json").json["leagues"][0]["verdicts"][0]["verdict"]
    result = league("verify", verdict, "--replays", "3")
    assert (result.code, "3 games replayed" in result.out) == (0, True)
    with registry.database.write() as session:
        row = session.get_one(VerdictRow, verdict)
        row.evidence = {**row.evidence, "llr": 99.0}  # type: ignore[dict-item]
    refuted = league("verify", verdict)
    assert (refuted.code, refuted.err.count("\n")) == (1, 1)
    assert "llr is 99.0, but the games give" in refuted.err


def test_a_verdict_whose_games_cannot_be_replayed_is_refuted(
    league: League, registry: Registry, config: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    verdict = league("nightly", config, "--workers", "0", "--json").json["leagues"][0]["verdicts"][0]["verdict"]
    step = tictactoe_v3.raw_env.step

    def step_without_rewards(self: Any, action: int | None) -> None:
        step(self, action)
        self.rewards = dict.fromkeys(self.rewards, float("nan"))

    monkeypatch.setattr(tictactoe_v3.raw_env, "step", step_without_rewards)
    refuted = league("verify", verdict, "--replays", "1")
    assert (refuted.code, refuted.err.count("\n")) == (1, 1)
    assert "cannot be replayed: agent player_1 got a reward of nan" in refuted.err
