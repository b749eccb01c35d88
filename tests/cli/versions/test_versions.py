from concurrent.futures import ThreadPoolExecutor

import pytest

from evaluation.gating.verdicts import open_verdict
from evaluation.service.snapshots import refresh
from league.config.league import LeagueConfig
from league.registry.registry import Registry
from tests.support.command import League
from tests.support.databases import on_both_databases

pytestmark = on_both_databases


def test_versions_as_json(league: League, registry: Registry) -> None:
    league("promote", "tictactoe@2", "--yes")
    document = league("versions", "tictactoe", "--json").json
    assert document["league"] == "tictactoe"
    assert [version["version"] for version in document["versions"]] == [1, 2, 3]
    assert [version["aliases"] for version in document["versions"]] == [[], ["champion"], []]
    assert {"rating", "interval", "games", "steps", "parent", "sha256", "created_at"} <= set(document["versions"][0])


def test_versions_as_a_table(league: League, registry: Registry) -> None:
    lines = league("versions", "tictactoe").out.splitlines()
    assert lines[0].split()[:3] == ["version", "aliases", "rating"]
    assert len(lines) == 4


def test_ratings_that_a_server_has_computed_are_the_same(league: League, registry: Registry) -> None:
    league("evaluate", "tictactoe", "--blocks", "4", "--workers", "0")
    computed = league("versions", "tictactoe", "--json").json
    assert all(version["rating"] is not None for version in computed["versions"])
    refresh(registry, "tictactoe")
    assert registry.snapshots.current("tictactoe", "leaderboard") is not None
    assert league("versions", "tictactoe", "--json").json == computed
    league("evaluate", "tictactoe", "--blocks", "8", "--workers", "0")
    assert registry.snapshots.current("tictactoe", "leaderboard") is None
    newer = league("versions", "tictactoe", "--json").json["versions"]
    assert all(new["games"] > old["games"] for new, old in zip(newer, computed["versions"], strict=True))


def test_ratings_from_before_a_change_of_the_code_are_shown_as_such(
    league: League, registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    league("evaluate", "tictactoe", "--blocks", "4", "--workers", "0")
    assert league("versions", "tictactoe").err == ""
    changed = registry.leagues.get("tictactoe").game | {"environment.source": "1" * 64}
    monkeypatch.setattr(LeagueConfig, "game", lambda self: changed)
    found = league("versions", "tictactoe")
    assert "→ 111111111111. These results are of the game before." in found.err


def test_notes_are_added_shown_and_removed(league: League, registry: Registry) -> None:
    assert league("note", "tictactoe@2", "[bold]entropy", "--actor", "ada").out == "tictactoe@2: [bold]entropy\n"
    assert league("versions", "tictactoe").out.splitlines()[2].endswith("[bold]entropy")
    notes = [version["note"] for version in league("versions", "tictactoe", "--json").json["versions"]]
    assert [note and (note["text"], note["actor"]) for note in notes] == [None, ("[bold]entropy", "ada"), None]
    assert league("note", "tictactoe@2", "").out == "tictactoe@2: note cleared\n"
    assert registry.versions.get("tictactoe", 2).note is None


def test_terminal_control_characters_are_escaped(league: League, registry: Registry) -> None:
    hostile = "\x1b]0;owned\x07 \x9b31m\r"
    outputs = [
        league("note", "tictactoe@2", hostile).out,
        league("promote", "tictactoe@2", "--yes", "--reason", hostile, "--actor", hostile).out,
        league("versions", "tictactoe").out,
        league("history", "tictactoe").out,
    ]
    for out in outputs:
        assert not set(out) & {"\x1b", "\x07", "\x9b", "\r"}, out
    assert "�]0;owned�" in outputs[2]
    assert "�]0;owned�" in outputs[3]


def test_text_with_invalid_unicode_is_rejected(league: League, registry: Registry) -> None:
    for arguments in (("note", "tictactoe@2", "a\udcff"), ("promote", "tictactoe@2", "--yes", "--reason", "a\udcff")):
        result = league(*arguments)
        assert result.code == 2
        assert result.err.startswith("league: ")
        assert "is not valid text" in result.err
    assert registry.aliases.current("tictactoe") == {}
    assert registry.versions.get("tictactoe", 2).note is None


def test_promotions_rollbacks_and_their_history(league: League, registry: Registry) -> None:
    assert (
        "now points to version 1 (before: nothing)"
        in league("promote", "tictactoe@1", "--yes", "--reason", "the first").out
    )
    assert (
        "now points to version 3 (before: version 1)" in league("promote", "tictactoe@3", "--yes", "--actor", "ada").out
    )
    assert league("promote", "tictactoe@3", "--yes").out == "tictactoe@champion already points to version 3.\n"
    assert league("rollback", "tictactoe", "--json").json["version"] == 1
    events = league("history", "tictactoe", "--json").json["events"]
    assert [(event["version"], event["previous"], event["kind"]) for event in events] == [
        (1, 3, "rollback"),
        (3, 1, "set"),
        (1, None, "set"),
    ]
    assert events[1]["actor"] == "ada"
    assert events[2]["reason"] == "the first"
    then = events[1]["at"]
    assert [event["version"] for event in league("history", "tictactoe", "--at", then, "--json").json["events"]] == [3]
    outcome = league("rollback", "tictactoe", "--expected", "3")
    assert outcome.code == 1
    assert "is at tictactoe@1 now, expected tictactoe@3: nothing was changed" in outcome.err
    outcome = league("rollback", "tictactoe", "--expected", "1")
    assert outcome.code == 1
    assert outcome.err.startswith("league: ")


def test_a_version_that_never_played_or_was_rejected_becomes_champion_with_yes_only(
    league: League, registry: Registry
) -> None:
    refused = league("promote", "tictactoe@1")
    assert refused.code == 2
    assert refused.err.startswith("league: tictactoe@1 has played no game under the current conditions")
    assert "confirm with --yes that tictactoe@1 shall be champion" in refused.err
    assert league("promote", "tictactoe@1", "--json").code == 2
    moved = league("promote", "tictactoe@1", "--expected", "2")
    assert "is not set, expected tictactoe@2" in moved.err, "what fails even with --yes is said at once"
    assert registry.aliases.current("tictactoe") == {}
    assert league("promote", "tictactoe@1", "--alias", "candidate").code == 0, "other aliases are not asked about"
    league("evaluate", "tictactoe", "--blocks", "2", "--workers", "0")
    assert league("promote", "tictactoe@1").code == 0
    verdict = open_verdict(registry, registry.leagues.get("tictactoe"), 2, "tictactoe@1")
    registry.verdicts.close(verdict.id, "reject", {"reason": "Not stronger: it scored 40.0 % against tictactoe@1."})
    refused = league("promote", "tictactoe@2")
    assert refused.code == 2
    rejected = f"the gate has rejected tictactoe@2 in verdict {verdict.short_id}: Not stronger: it scored 40.0 %"
    assert rejected in refused.err
    assert league("promote", "tictactoe@2", "--yes").code == 0
    assert league("promote", "tictactoe@2").code == 0, "it is champion already"


def test_of_two_concurrent_promotions_one_fails(league_process: League, registry: Registry) -> None:
    league_process("promote", "tictactoe@1", "--yes")
    with ThreadPoolExecutor(2) as pool:
        refs = ("tictactoe@2", "tictactoe@3")
        results = list(pool.map(lambda ref: league_process("promote", ref, "--yes", "--expected", "1"), refs))
    assert sorted(outcome.code for outcome in results) == [0, 1]
    loser = max(results, key=lambda outcome: outcome.code)
    winner = registry.aliases.current("tictactoe")["champion"]
    assert loser.err.startswith("league: ")
    assert str(winner) in loser.err


def test_another_alias_can_be_moved(league: League, registry: Registry) -> None:
    league("promote", "tictactoe@2", "--yes", "--alias", "candidate", "--expected", "none")
    assert registry.aliases.current("tictactoe") == {"candidate": 2}
