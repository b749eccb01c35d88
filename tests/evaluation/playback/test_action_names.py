import pytest

from evaluation.playback.action_names import action_names, direction_keys
from league.config.league import LeagueConfig
from league.environments.building import interface
from tests.support.leagues import tictactoe


@pytest.mark.parametrize(
    ("names", "keys"),
    [
        (("up", "left", "down", "right"), {"w": 0, "ArrowUp": 0, "a": 1, "s": 2, "d": 3}),
        (("no_action", "move_left", "MOVE RIGHT"), {"a": 1, "ArrowRight": 2, "d": 2}),
        (("North", "go west"), {"ArrowUp": 0, "ArrowLeft": 1}),
        (("up-left", "up", "fire left", "left"), {"ArrowUp": 1, "ArrowLeft": 3}),
        (("jump left", "fire left"), {}),
        (("rock", "paper", "leftover", "supper"), {}),
    ],
)
def test_names_of_directions_have_keys(names: tuple[str, ...], keys: dict[str, int]) -> None:
    found = direction_keys({str(action): name for action, name in enumerate(names)})
    assert found.items() >= keys.items()
    assert set(found.values()) == set(keys.values())


def test_names_belong_to_the_policies_of_agents() -> None:
    names = {"first": list("abcdefghi")}
    config = tictactoe.config(policies={"first": ["player_1"], "second": ["player_2"]}, play={"action_names": names})
    assert action_names(config.play, interface(config)) == {
        "player_1": {str(action): name for action, name in enumerate(names["first"])}
    }


def test_names_follow_the_first_action() -> None:
    config = LeagueConfig.load("policy_league/configs/simple_spread.yaml")
    named = action_names(config.play, interface(config))
    assert direction_keys(named["agent_0"]).items() >= {"ArrowLeft": 1, "ArrowRight": 2, "ArrowDown": 3, "w": 4}.items()
