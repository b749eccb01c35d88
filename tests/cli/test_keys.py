from datetime import UTC, datetime, timedelta

import pytest

from league.registry.registry import Registry
from tests.cli.conftest import League


def test_a_key_is_shown_once_listed_and_revoked(league: League, registry: Registry) -> None:
    assert "no key yet" in league("keys", "list").out
    made = league("keys", "create", "lobby", "--scope", "act", "--scope", "read", "--rate", "600/m", "--expires", "30d")
    token = made.out.splitlines()[0]
    assert token.startswith("plk_")
    assert "only time" in made.out
    (key,) = league("keys", "list", "--json").json["keys"]
    assert (key["name"], key["scopes"], key["rate"], key["state"]) == ("lobby", ["act", "read"], 10, "valid")
    ends_in = datetime.fromisoformat(key["expires_at"]) - datetime.now(UTC)
    assert timedelta(days=29) < ends_in <= timedelta(days=30)
    assert token not in league("keys", "list").out
    assert token.encode() not in b"".join(path.read_bytes() for path in registry.storage.home.glob("league.db*"))
    assert "opens nothing any more" in league("keys", "revoke", "lobby").out
    assert league("keys", "list", "--json").json["keys"][0]["state"] == "revoked"


def test_as_json_the_key_stands_in_the_document(league: League, registry: Registry) -> None:
    document = league("keys", "create", "duo", "--scope", "promote", "--league", "tictactoe", "--json").json
    assert document["key"].startswith("plk_")
    assert (document["leagues"], document["expires_at"], document["rate"]) == (["tictactoe"], None, None)
    assert "sha256" not in document
    assert registry.api_keys()[0].name == "duo"


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("create", "x", "--scope", "fly"), "fly"),
        (("create", "x", "--scope", "act", "--rate", "fast"), "--rate 'fast': expected a number"),
        (("create", "x", "--scope", "act", "--expires", "soon"), "--expires 'soon': expected a number"),
        (("create", "x", "--scope", "act", "--league", "Not A Slug"), "Not A Slug"),
        (("revoke", "nobody"), "nobody"),
    ],
)
def test_a_mistake_is_a_line_and_makes_no_key(
    league: League, registry: Registry, arguments: tuple[str, ...], told: str
) -> None:
    outcome = league("keys", *arguments)
    assert (outcome.code, outcome.err.count("\n")) == (2, 1), outcome.err
    assert told in outcome.err
    assert registry.api_keys() == []
