from datetime import UTC, datetime, timedelta

import pytest

from league.registry.registry import Registry
from tests.support.command import League
from tests.support.databases import on_both_databases

pytestmark = on_both_databases


def test_a_key_is_shown_once_listed_and_revoked(league: League, registry: Registry) -> None:
    assert "No API keys" in league("keys", "list").out
    created = league(
        "keys", "create", "lobby", "--scope", "act", "--scope", "read", "--rate", "600/m", "--expires", "30d"
    )
    token = created.out.splitlines()[0]
    assert token.startswith("plk_")
    assert "it is not shown again" in created.out
    assert "require a key for every request" in created.out
    (key,) = league("keys", "list", "--json").json["keys"]
    assert (key["name"], key["scopes"], key["rate"], key["state"]) == ("lobby", ["act", "read"], 10, "valid")
    ends_in = datetime.fromisoformat(key["expires_at"]) - datetime.now(UTC)
    assert timedelta(days=29) < ends_in <= timedelta(days=30)
    assert token not in league("keys", "list").out
    assert token.encode() not in b"".join(path.read_bytes() for path in registry.storage.home.glob("league.db*"))
    assert "No valid key is left" in league("keys", "revoke", "lobby").out
    assert league("keys", "list", "--json").json["keys"][0]["state"] == "revoked"


def test_the_json_document_contains_the_key(league: League, registry: Registry) -> None:
    document = league("keys", "create", "duo", "--scope", "promote", "--league", "tictactoe", "--json").json
    assert document["key"].startswith("plk_")
    assert (document["leagues"], document["expires_at"], document["rate"]) == (["tictactoe"], None, None)
    assert "sha256" not in document
    assert registry.keys.all()[0].name == "duo"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("create", "x", "--scope", "fly"), "fly"),
        (("create", "x", "--scope", "act", "--rate", "fast"), "--rate 'fast': expected a number"),
        (("create", "x", "--scope", "act", "--expires", "soon"), "--expires 'soon': expected a number"),
        (("create", "x", "--scope", "act", "--league", "Not A Slug"), "Not A Slug"),
        (("revoke", "nobody"), "nobody"),
    ],
)
def test_a_usage_error_is_one_line_and_creates_no_key(
    league: League, registry: Registry, arguments: tuple[str, ...], message: str
) -> None:
    result = league("keys", *arguments)
    assert (result.code, result.err.count("\n")) == (2, 1), result.err
    assert message in result.err
    assert registry.keys.all() == []
