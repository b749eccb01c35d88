"""`league remove`: what it shows, asks and removes."""

from league.registry.registry import Registry
from tests.support.command import League
from tests.support.leagues import tictactoe

NAME = tictactoe.LEAGUE


def test_a_version_is_removed_after_confirmation(league: League, registry: Registry) -> None:
    asked = league("remove", "tictactoe@2")
    assert (asked.code, "--yes" in asked.err) == (2, True)
    shown = league("remove", "tictactoe@2", "--dry-run", "--json").json
    assert (shown["dry_run"], shown["target"], list(shown["versions"])) == (True, "tictactoe@2", ["2"])
    removed = league("remove", "tictactoe@2", "--yes")
    assert removed.code == 0, removed.err
    assert removed.out.endswith("Removed tictactoe@2.\n")
    assert [row.number for row in registry.versions.all(NAME)] == [1, 3]
    assert not registry.artifacts.path(NAME, 2).exists()
    assert league("remove", "tictactoe@2", "--yes").code == 2


def test_the_champion_is_removed_by_force_only(league: League, registry: Registry) -> None:
    league("promote", "tictactoe@1", "--yes")
    refused = league("remove", "tictactoe@champion", "--yes")
    assert refused.code == 1
    assert "tictactoe@1 is in use: the alias champion points to it" in refused.err
    assert "--force" in refused.err
    assert league("remove", "tictactoe@1", "--dry-run").code == 0
    assert registry.aliases.current(NAME) == {"champion": 1}
    assert league("remove", "tictactoe@champion", "--yes", "--force").code == 0
    assert registry.aliases.current(NAME) == {}


def test_a_league_is_removed_with_its_report_and_runs(league: League, registry: Registry) -> None:
    report = registry.storage.home / "reports" / f"{NAME}.html"
    report.parent.mkdir()
    report.write_text("a report")
    league("promote", "tictactoe@1", "--yes")
    refused = league("remove", NAME, "--yes")
    assert (refused.code, "tictactoe is in use: the alias champion is set" in refused.err) == (1, True)
    removed = league("remove", NAME, "--yes", "--force")
    assert removed.code == 0, removed.err
    assert "tictactoe: 3 versions, " in removed.out
    assert registry.leagues.names() == {}
    assert not report.exists()
    assert league("remove", NAME, "--yes").code == 2


def test_nothing_is_removed_during_a_nightly_run(league: League, registry: Registry) -> None:
    with registry.exclusive_lock(f"nightly-{NAME}"):
        refused = league("remove", "tictactoe@2", "--yes")
    assert (refused.code, "another process is running nightly-tictactoe" in refused.err) == (1, True)
    assert len(registry.versions.all(NAME)) == 3
