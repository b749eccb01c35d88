"""`league retire`: what it shows, asks and removes."""

import os
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from sqlalchemy import update

from league.registry.registry import Registry
from league.registry.storage.rows import LeagueRow
from league.registry.storage.tables import VersionTable
from tests.support.command import League
from tests.support.leagues import tictactoe

YEAR = timedelta(days=365)


@pytest.fixture
def old(registry: Registry) -> Registry:
    """Three versions that are a year old; the first is the champion."""
    if not registry.aliases.current(tictactoe.LEAGUE):
        registry.aliases.set(tictactoe.LEAGUE, "champion", 1, expected=None, actor="me", reason="first")
    while len(registry.versions.all(tictactoe.LEAGUE)) < 3:
        tictactoe.publish(registry, tictactoe.graph(wins=True))
    with registry.database.write() as session:
        session.execute(update(VersionTable).values(reserved_at=datetime.now(UTC) - YEAR))
    return registry


@pytest.fixture
def log(home: Path) -> Path:
    """The access log of a replica that ended a year ago."""
    path = home / "logs" / "access-former.jsonl"
    path.parent.mkdir(parents=True)
    path.write_text("{}\n")
    then = time.time() - YEAR.total_seconds()
    os.utime(path, (then, then))
    return path


def test_a_dry_run_removes_nothing(league: League, old: Registry, log: Path) -> None:
    result = league("retire", "--keep=1", "--dry-run", "--json")
    (plan,) = result.json["leagues"]
    assert plan["versions"].keys() == {"2"}
    assert result.json["logs"] == [str(log)]
    assert log.exists()
    assert all(row.retired_at is None for row in old.versions.all(tictactoe.LEAGUE))
    assert "Would remove 1 access log files" in league("retire", "--keep=1", "--dry-run").out


def test_versions_and_logs_are_removed_once(league: League, old: Registry, log: Path) -> None:
    old.replicas.register("serving", {})
    current = log.with_name("access-serving.jsonl")
    current.write_text("{}\n")
    os.utime(current, (0, 0))
    result = league("retire", tictactoe.LEAGUE, "--keep=1", "--yes")
    assert result.code == 0, result.err
    assert [line.split()[:2] for line in result.out.splitlines() if line.startswith("tictactoe")] == [
        ["tictactoe", "2"]
    ]
    assert not log.exists()
    assert current.exists()
    assert "retired" in league("versions", tictactoe.LEAGUE).out
    assert league("retire", "--keep=1", "--yes").out == "There is nothing to remove.\n"
    result = league("export", f"{tictactoe.LEAGUE}@2")
    assert result.code != 0
    assert "tictactoe@2 was retired and its files were removed" in result.err


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


@pytest.mark.usefixtures("old")
def test_confirmation_is_required(league: League) -> None:
    result = league("retire", "--keep=1")
    assert result.code == 2
    assert "--yes" in result.err


@pytest.mark.usefixtures("old")
def test_an_unknown_league_is_reported(league: League) -> None:
    assert "there is no league 'other'" in league("retire", "other", "--yes").err
