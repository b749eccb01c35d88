from league.registry.registry import Registry
from league.registry.rows import Portion
from tests.cli.conftest import League


def test_canary_and_shadow_are_set_shown_and_ended(league: League, registry: Registry) -> None:
    assert "by its champion alone" in league("traffic", "tictactoe").out
    league("promote", "tictactoe@2", "--alias", "candidate")
    assert "tictactoe@candidate answers 5.0% of the keys" in league("traffic", "tictactoe", "--canary", "candidate").out
    out = league("traffic", "tictactoe", "--shadow", "tictactoe@3", "--shadow-share", "0.5", "--actor", "ada").out
    assert "tictactoe@candidate answers 5.0% of the keys" in out
    assert "tictactoe@3 is shown 50.0% of the requests" in out
    document = league("traffic", "tictactoe", "--share", "0.2", "--json").json
    assert document["canary"] == {"version": "candidate", "share": 0.2}
    assert league("traffic", "tictactoe", "--json").json["shadows"] == []
    league("traffic", "tictactoe", "--canary", "none")
    now = registry.traffic("tictactoe")
    assert (now.canary, now.shadow) == (None, Portion(3, 0.5))
    assert "by its champion alone" in league("traffic", "tictactoe", "--off").out


def test_mistakes_are_told_in_a_line(league: League, registry: Registry) -> None:
    for arguments, told in (
        (("--share", "0.2"), "a share needs a version: --canary REF"),
        (("--off", "--canary", "3"), "--off"),
        (("--canary", "connect_four@3"), "expected a version of league tictactoe"),
        (("--canary", "9"), "no version 9"),
        (("--shadow", "champion"), "must be another version"),
    ):
        outcome = league("traffic", "tictactoe", *arguments)
        assert (outcome.code, outcome.err.count("\n")) == (2, 1), outcome.err
        assert told in outcome.err
    outcome = league("traffic", "tictactoe", "--canary", "3", "--wait", "--timeout", "0")
    assert outcome.code == 1
    assert "is a server running" in outcome.err
