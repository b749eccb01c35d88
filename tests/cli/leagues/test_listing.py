"""`league list` and `league archive`, and what other commands do with an archived league."""

from pathlib import Path

import pytest
import yaml

from league.registry.registry import Registry
from tests.support.command import League
from tests.support.leagues import tictactoe

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
def test_an_archived_league_is_skipped_and_nothing_is_added_to_it(
    league: League, registry: Registry, tmp_path: Path
) -> None:
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
    assert league("nightly", NAME, "--workers", "0").code == 0


def test_a_league_is_not_archived_during_training(league: League, registry: Registry) -> None:
    registry.runs.begin(NAME, "active", algorithm="ppo", settings={}, seed=0, target=10)
    refused = league("archive", NAME)
    assert (refused.code, "training run active of league tictactoe is active" in refused.err) == (1, True)
    assert league("archive", "chess").code == 2
