from typing import Any

import pytest

from league.config.league import LeagueConfig
from league.errors import ConfigError


def league(**play: Any) -> LeagueConfig:
    return LeagueConfig.from_mapping(
        {"league": "mini", "environment": {"entry_point": "mpe2.simple_spread_v3"}, "play": play}, source="mini.yaml"
    )


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ([], "play.action_names.*at least one name"),
        (["up", "up"], "'up' is the name of several actions"),
        (["up", " "], "1 to 40 characters"),
        (["x" * 41], "1 to 40 characters"),
        ([True, "no"], "play.action_names"),
        ({"shared": ["a", "a"]}, "'a' is the name of several actions"),
    ],
)
def test_invalid_names_are_reported(names: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=f"mini.yaml: .*{message}"):
        league(action_names=names)


def test_names_do_not_change_the_game() -> None:
    assert league(action_names=["stay", "left"]).game_digest() == league().game_digest()


def test_names_are_those_of_all_policies_or_of_one() -> None:
    assert league(action_names=["a", "b"]).play.names_for("any") == ("a", "b")
    assert league(action_names={"one": ["a"]}).play.names_for("one") == ("a",)
    assert league(action_names={"one": ["a"]}).play.names_for("other") == ()
    assert league().play.names_for("one") == ()
