"""`league compare`."""

import pytest

from league.registry.registry import Registry
from league.registry.storage.rows import RunPoint
from policy_league.cli import output
from tests.support.command import League
from tests.support.leagues import tictactoe

RUNS = ("20261124-080000-aa12bc", "20261125-080000-de34f5")


@pytest.fixture
def runs(registry: Registry) -> tuple[str, str]:
    for run, lr in zip(RUNS, (0.001, 0.0005), strict=True):
        settings = {"lr": lr, "gamma": 0.99}
        registry.runs.begin(tictactoe.LEAGUE, run, algorithm="ppo", settings=settings, seed=1, target=9000)
        at = registry.runs.get(tictactoe.LEAGUE, run).began_at
        registry.runs.record(
            tictactoe.LEAGUE,
            run,
            RunPoint(
                tictactoe.LEAGUE,
                run,
                600_000,
                {"shared/return": lr, "opponents/script:nim_bot:act/score": 0.5},
                at,
            ),
            seconds=120.0,
        )
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


def test_versions_that_have_not_played_each_other_are_named(
    league: League, registry: Registry, runs: tuple[str, str]
) -> None:
    first, second = (tictactoe.publish(registry, tictactoe.graph(), source=f"{run}/checkpoint").ref for run in runs)
    out = " ".join(league("compare", *runs).out.split())
    assert f"have not played each other: league evaluate tictactoe {first} {second}" in out


@pytest.mark.usefixtures("runs")
def test_unknown_and_ambiguous_runs_are_usage_errors(league: League) -> None:
    for name, message in (
        ("2026", "is ambiguous"),
        ("chess/1", "there is no training run 'chess/1'"),
        ("x", RUNS[1]),
        ("20261124", f"are the same run, tictactoe/{RUNS[0]}"),
    ):
        result = league("compare", RUNS[0], name)
        assert (result.code, result.err.count("\n")) == (2, 1)
        assert message in result.err
