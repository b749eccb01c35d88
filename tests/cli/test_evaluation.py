from pathlib import Path

import pytest
import yaml

from league.registry.registry import Registry
from league.registry.tables import Verdict
from tests.cli.conftest import League
from tests.evaluation import examples


@pytest.fixture
def config(tmp_path: Path) -> str:
    path = tmp_path / "tictactoe.yaml"
    path.write_text(yaml.safe_dump(examples.config().model_dump(mode="json", by_alias=True)))
    return str(path)


def test_evaluate_as_json(league: League, registry: Registry) -> None:
    document = league("evaluate", "tictactoe", "--blocks", "20", "--workers", "0", "--json").json
    standings = {standing["ref"]: standing for standing in document["standings"]}
    assert set(standings) == {"tictactoe@1", "tictactoe@2", "tictactoe@3", "script:random", "script:one_ply"}
    assert standings["script:random"]["rating"] == 0
    for standing in standings.values():
        assert {"mean_return", "score", "rating", "interval", "games"} <= set(standing)
        low, high = standing["interval"]
        assert low <= standing["rating"] <= high
    assert standings["tictactoe@3"]["rating"] > standings["tictactoe@1"]["rating"]


def test_evaluate_as_tables(league: League, registry: Registry) -> None:
    out = league("evaluate", "tictactoe", "tictactoe@1", "tictactoe@3", "--blocks", "4", "--workers", "0").out
    assert "tictactoe@3" in out
    assert "script:one_ply" in out


def test_evaluate_within_a_budget(league: League, registry: Registry) -> None:
    options = ("--schedule", "adaptive", "--games", "41", "--workers", "0")
    assert "40 games" in (out := league("evaluate", "tictactoe", *options).out)
    assert "the games are used up" in out
    document = league("evaluate", "tictactoe", *options, "--json").json
    assert (document["kind"], document["stopped_by"], document["games"]) == ("adaptive", "games", 40)
    assert document["population"] is None


def test_evaluate_tells_shares_of_a_whole_table(league: League, registry: Registry) -> None:
    told = league("evaluate", "tictactoe", "--blocks", "4", "--workers", "0")
    assert "α-Rank" in told.out
    population = league("evaluate", "tictactoe", "--blocks", "4", "--workers", "0", "--json").json["population"]
    for shares in population.values():
        assert sum(share["value"] for share in shares) == pytest.approx(1)
        assert all(share["low"] <= share["high"] for share in shares)


def test_a_night_judges_promotes_and_rates_and_the_next_has_nothing_to_do(
    league: League, registry: Registry, config: str
) -> None:
    told = league("nightly", config, "--workers", "0")
    assert told.code == 0, told.err
    assert "tictactoe@1 against script:random" in told.out
    champion = registry.aliases("tictactoe")["champion"]
    assert f"the champion is now tictactoe@{champion}" in told.out
    again = league("nightly", config, "--workers", "0", "--json").json["leagues"][0]
    assert again["verdicts"] == []
    assert again["champion"] == f"tictactoe@{champion}"
    rated = league("versions", "tictactoe", "--json").json["versions"]
    assert all(version["rating"] is not None for version in rated)


def test_a_verdict_is_verified_and_a_changed_one_fails(league: League, registry: Registry, config: str) -> None:
    verdict = league("nightly", config, "--workers", "0", "--json").json["leagues"][0]["verdicts"][0]["verdict"]
    told = league("verify", verdict, "--replays", "3")
    assert (told.code, "3 games were played again" in told.out) == (0, True)
    with registry.database.write() as session:
        row = session.get_one(Verdict, verdict)
        row.evidence = {**row.evidence, "llr": 99.0}  # type: ignore[dict-item]
    refuted = league("verify", verdict)
    assert (refuted.code, refuted.err.count("\n")) == (1, 1)
    assert "llr is 99.0, and by the games" in refuted.err
