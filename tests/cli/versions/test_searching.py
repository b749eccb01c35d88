"""`league search`."""

from league.registry.registry import Registry
from tests.support.command import League
from tests.support.leagues import tictactoe
from tests.support.policies.graphs import masked_mlp


def test_a_search_version_is_published_and_shown(league: League, registry: Registry) -> None:
    value = masked_mlp((3, 3, 2), 9, has_value=True)
    tictactoe.publish(registry, masked_mlp((3, 3, 2), 9), value=value)
    out = league("search", "tictactoe@4", "--simulations", "20", "--rule", "gumbel", "--note", "looks ahead").out
    assert out == "tictactoe@5 plays tictactoe@4 with a search of 20 simulations (gumbel)\n"
    listed = league("versions", "tictactoe", "--json").json["versions"][-1]
    assert (listed["role"], listed["note"]["text"]) == ("search", "looks ahead")
    assert {"version": 4, "rule": "gumbel", "simulations": 20}.items() <= listed["search"].items()
    assert "search with @4, 20 simulations, gumbel" in league("versions", "tictactoe").out
    again = league("search", "tictactoe@4", "--simulations", "20", "--rule", "gumbel", "--json").json
    assert again == {"league": "tictactoe", "version": 5, "search": listed["search"]}
    assert league("search", "tictactoe@1").err.startswith("league: tictactoe@1 has no value graph")
