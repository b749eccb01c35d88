"""`league promote` of a mixture, and `league mixture`."""

import pytest

from league.registry.registry import Registry
from league.results.payoffs import MetaStrategy
from tests.support.command import League
from tests.support.servers.streaming import listening

REFS = ("tictactoe@1", "tictactoe@2", "tictactoe@3")


def test_a_mixture_is_promoted_shown_and_rolled_back(league: League, registry: Registry) -> None:
    league("promote", "tictactoe@1", "--yes")
    out = league("promote", "tictactoe@1:0.6,tictactoe@3:0.4", "--yes", "--to", "champion").out
    assert "tictactoe@champion now points to version 4 (before: version 1)." in out
    assert "mixture of @1 60.0 %, @3 40.0 %" in league("versions", "tictactoe").out
    assert "4 (@1 60.0 %, @3 40.0 %)" in league("history", "tictactoe").out
    event = league("history", "tictactoe", "--json").json["events"][0]
    assert (event["version"], [member["version"] for member in event["members"]]) == (4, [1, 3])
    assert league("promote", "tictactoe@3:0.4,@1:0.6", "--yes", "--json").json["id"] == event["id"], "nothing changes"
    assert league("rollback", "tictactoe", "--json").json["version"] == 1


def test_replicas_are_waited_for(league: League, registry: Registry) -> None:
    league("promote", "tictactoe@1", "--yes")
    with listening(registry.storage):
        assert "Confirmed by 1 replica." in league("promote", "tictactoe@1:0.6,tictactoe@3:0.4", "--yes", "--wait").out
        assert "Confirmed by 1 replica." in league("rollback", "tictactoe", "--wait").out
    result = league("promote", "tictactoe@1:0.6,tictactoe@3:0.4", "--yes", "--wait", "--timeout", "0")
    assert result.code == 1
    assert "is a server running" in result.err
    assert registry.versions.resolve("tictactoe@champion").mixture is not None


@pytest.mark.parametrize(
    ("ref", "message"),
    [
        ("tictactoe@1:0.6,tictactoe@9:0.4", "league tictactoe has no version 9; the newest is 3"),
        ("tictactoe@1:0.6,tictactoe@2:0.3", "the probabilities of the mixture sum to 0.9, expected 1"),
        ("tictactoe@1:0.6,chess@2:0.4", "chess@2 is not a version of league tictactoe: a mixture has one league"),
        ("tictactoe@1:0.6,tictactoe@2", "'tictactoe@2' has no probability: expected LEAGUE@VERSION:PROBABILITY"),
        ("tictactoe@1:x,tictactoe@2:0.4", "'x' is not a probability: expected tictactoe@1:PROBABILITY"),
        ("tictactoe@1:0.5,tictactoe@1:0.5", "tictactoe@1 is twice in the mixture"),
        ("tictactoe@1:1", "a mixture has 1 version, expected at least two"),
        ("tictactoe@mixed:0.5,@1:0.5", "tictactoe@4 is a mixture (@1 50.0 %, @2 50.0 %): name one of its members"),
    ],
)
def test_an_invalid_mixture_changes_nothing(league: League, registry: Registry, ref: str, message: str) -> None:
    if "mixed" in ref:
        league("promote", "tictactoe@1:0.5,@2:0.5", "--yes", "--to", "mixed")
    before = registry.aliases.current("tictactoe"), registry.versions.numbers("tictactoe")
    result = league("promote", ref, "--yes")
    assert result.code in (1, 2)
    assert result.err.startswith(f"league: {message}")
    assert result.err.count("\n") == 1
    assert (registry.aliases.current("tictactoe"), registry.versions.numbers("tictactoe")) == before


def test_the_equilibrium_is_shown_and_becomes_an_alias(
    league: League, registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = league("mixture", "tictactoe")
    assert result.err.startswith("league: no two of the 3 versions have played each other: `league evaluate LEAGUE`")
    league("evaluate", "tictactoe", "--games", "60", "--workers", "0")
    shown = league("mixture", "tictactoe").out
    assert shown.splitlines()[0].split() == ["version", "probability", "score", "against", "it"]
    assert "Computed from" in shown
    assert registry.aliases.current("tictactoe") == {}, "nothing is set without --alias"
    members = league("mixture", "tictactoe", "--method", "alpha_rank", "--json").json["members"]
    assert sum(members.values()) == pytest.approx(1)
    assert "confirm with --yes" in league("mixture", "tictactoe", "--alias", "mix").err
    out = league("mixture", "tictactoe", "--alias", "mix", "--method", "alpha_rank", "--at-least", "0", "--yes").out
    assert "tictactoe@mix now points to version" in out
    target = registry.versions.resolve("tictactoe@mix")
    assert target.mixture is None or set(target.mixture.versions) <= {1, 2, 3}
    assert "'best': expected nash or alpha_rank" in league("mixture", "tictactoe", "--method", "best").err
    alike = MetaStrategy(REFS, (1 / 3,) * 3, ((0.5,) * 3,) * 3, 60, 0)
    monkeypatch.setattr("league.results.payoffs.meta_strategy", lambda *_: alike)
    refused = league("mixture", "tictactoe", "--at-least", "0.4", "--alias", "mix", "--yes")
    assert refused.err == "league: --at-least 0.4: no version is as probable; the highest probability is 0.333\n"


def test_scores_are_those_against_the_mixture_that_is_shown(
    league: League, registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The third version is left out: three of five opponents are the first version, the others the second."""
    payoff = ((0.5, 0.8, 0.2), (0.2, 0.5, 0.9), (0.8, 0.1, 0.5))
    found = MetaStrategy(REFS, (1 / 2, 1 / 3, 1 / 6), payoff, 60, 0)
    monkeypatch.setattr("league.results.payoffs.meta_strategy", lambda *_: found)
    lines = league("mixture", "tictactoe", "--at-least", "0.2").out.splitlines()[1:4]
    assert [line.split() for line in lines] == [
        ["tictactoe@1", "0.600", "0.620"],
        ["tictactoe@2", "0.400", "0.320"],
        ["tictactoe@3", "0.000", "0.520"],
    ]


def test_what_needs_one_policy_names_the_members(league: League, registry: Registry) -> None:
    league("promote", "tictactoe@1:0.5,@2:0.5", "--yes")
    message = "league: tictactoe@4 is a mixture (@1 50.0 %, @2 50.0 %): name one of its members\n"
    assert league("export", "tictactoe@champion").err == message
    assert league("act", "tictactoe@champion", "--local", "--json").json["version"] in (1, 2)
