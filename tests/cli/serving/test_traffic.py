from league.registry.registry import Registry
from league.registry.storage.rows import Portion
from tests.support.command import League
from tests.support.databases import on_both_databases

pytestmark = on_both_databases


def test_canary_and_shadow_are_set_shown_and_ended(league: League, registry: Registry) -> None:
    assert "the champion serves all requests" in league("traffic", "tictactoe").out
    league("promote", "tictactoe@2", "--yes", "--alias", "candidate")
    assert (
        "tictactoe@candidate is the canary for 5.0% of the routing keys"
        in league("traffic", "tictactoe", "--canary", "candidate").out
    )
    out = league("traffic", "tictactoe", "--shadow", "tictactoe@3", "--shadow-share", "0.5", "--actor", "ada").out
    assert "tictactoe@candidate is the canary for 5.0% of the routing keys" in out
    assert "tictactoe@3 is the shadow for 50.0% of the requests" in out
    document = league("traffic", "tictactoe", "--share", "0.2", "--json").json
    assert document["canary"] == {"version": "candidate", "share": 0.2}
    assert league("traffic", "tictactoe", "--json").json["shadows"] == []
    league("traffic", "tictactoe", "--canary", "none")
    now = registry.traffic.current("tictactoe")
    assert (now.canary, now.shadow) == (None, Portion(3, 0.5))
    assert "the champion serves all requests" in league("traffic", "tictactoe", "--off").out


def test_usage_errors_are_one_line(league: League, registry: Registry) -> None:
    for arguments, message in (
        (("--share", "0.2"), "a share requires a version: --canary REF"),
        (("--off", "--canary", "3"), "--off"),
        (("--canary", "connect_four@3"), "expected a version of league tictactoe"),
        (("--canary", "9"), "no version 9"),
        (("--shadow", "champion"), "must be another version"),
    ):
        result = league("traffic", "tictactoe", *arguments)
        assert (result.code, result.err.count("\n")) == (2, 1), result.err
        assert message in result.err
    result = league("traffic", "tictactoe", "--canary", "3", "--wait", "--timeout", "0")
    assert result.code == 1
    assert "is a server running" in result.err
