from contextlib import closing
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pettingzoo.classic import connect_four_v3

from evaluation.playback.environment_hooks import KNOWN, environment_hooks
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
    assert environment_hooks(EnvironmentConfig(entry_point="policy_league.examples.kuhn_poker:env")).draws is False


@pytest.mark.parametrize(
    ("declared", "message"),
    [
        ({"board": [[0, 1], [2]]}, "board: .*rows of equal length"),
        ({"board": []}, "board: .*rows of equal length"),
        ({"board": [["a"]]}, r"board\[0\]\[0\]: .*integer"),
        ({"board_area": [0, 0, 1]}, r"board_area\[3\]: .*required"),
        ({"board_area": [0.5, 0, 0.5, 1]}, "board_area: .*left < right"),
        ({"board_area": [0, 0, 640, 480]}, "board_area: .*between 0 and 1"),
        ({"board_area": [float("nan"), 0, 1, 1]}, "board_area: .*between 0 and 1"),
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


def test_a_board_without_an_area_covers_the_picture() -> None:
    declared = environment_hooks(EnvironmentConfig(entry_point=f"{DECLARING}:Declaring")).declared
    assert declared.board_area == (0, 0, 1, 1)


def test_cells_of_connect_four_are_around_its_holes() -> None:
    """The holes are the white parts of the picture of an empty board."""
    with closing(connect_four_v3.env(render_mode="rgb_array")) as env:
        env.reset()
        holes = env.render().min(axis=2) == 255
    left, top, right, bottom = KNOWN["connect_four_v3"]["board_area"]
    height, width = holes.shape
    for centres, (low, high), cells in (
        (centres_of(holes.any(axis=0)) / width, (left, right), 7),
        (centres_of(holes.any(axis=1)) / height, (top, bottom), 6),
    ):
        assert centres == pytest.approx(low + (np.arange(cells) + 0.5) * (high - low) / cells, abs=0.002)


def centres_of(inside: NDArray[np.bool_]) -> NDArray[np.float64]:
    """The centres of the runs of True, in pixels."""
    edges = np.flatnonzero(np.diff(np.pad(inside, 1).astype(int)))
    return (edges[::2] + edges[1::2]) / 2
