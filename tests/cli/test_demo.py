import numpy as np

from policy_league.cli.demo import drawing


def test_a_board_is_drawn_with_its_columns() -> None:
    planes = np.zeros((2, 3, 2), np.int8)
    planes[1, 0, 0] = planes[1, 2, 1] = 1
    assert drawing(planes) == "· · ·\n● · ○\n0 1 2"


def test_other_observations_are_not_drawn() -> None:
    assert drawing(np.zeros((6, 7), np.int8)) is None
    assert drawing(np.full((2, 2, 2), 3)) is None
