from typing import Any

import pytest

from evaluation.playback.environment_hooks import environment_hooks
from league.config.environment import EnvironmentConfig
from league.errors import EnvironmentMismatch

DECLARING = "tests.support.environments.declaring"


@pytest.mark.parametrize(
    ("entry_point", "board"),
    [
        ("pettingzoo.classic.connect_four_v3", ((0, 1, 2, 3, 4, 5, 6),)),
        ("pettingzoo.classic.tictactoe_v3", ((0, 3, 6), (1, 4, 7), (2, 5, 8))),
        ("mpe2.simple_spread_v3", None),
        (f"{DECLARING}:Declaring", ((0, None), (1, 2))),
    ],
)
def test_the_board_is_declared(entry_point: str, board: Any) -> None:
    assert environment_hooks(EnvironmentConfig(entry_point=entry_point)).declared.board == board


def test_declarations_are_found_behind_wrappers() -> None:
    config = EnvironmentConfig.model_validate(
        {"entry_point": f"{DECLARING}:Declaring", "wrappers": ["pad_action_space_v0"]}
    )
    found = environment_hooks(config)
    assert (found.draws, found.has_views) == (True, True)
    assert found.declared.agent_colors == {"player_1": "red"}


def test_an_environment_without_pictures_has_no_views() -> None:
    assert environment_hooks(EnvironmentConfig(entry_point="examples.kuhn_poker:env")).draws is False


@pytest.mark.parametrize(
    ("declared", "message"),
    [
        ({"board": [[0, 1], [2]]}, "board: .*rows of equal length"),
        ({"board": []}, "board: .*rows of equal length"),
        ({"board": [["a"]]}, r"board\[0\]\[0\]: .*integer"),
        ({"action_keys": {"w": "up"}}, "action_keys.w: .*integer"),
        ({"agent_colors": {"player_1": "url(x)"}}, "agent_colors: .*player_1: 'url\\(x\\)' is neither"),
    ],
)
def test_malformed_declarations_are_reported_with_their_key(declared: dict[str, Any], message: str) -> None:
    config = EnvironmentConfig(entry_point=f"{DECLARING}:Malformed", kwargs=declared)
    with pytest.raises(EnvironmentMismatch, match=f"metadata of {DECLARING}:Malformed: {message}"):
        environment_hooks(config)


def test_declarations_of_an_instance_are_used() -> None:
    config = EnvironmentConfig(entry_point=f"{DECLARING}:Malformed", kwargs={"board": [[3]]})
    assert environment_hooks(config).declared.board == ((3,),)
