"""When two actions are regarded as equal."""

import numpy as np

from league.policies.probes import NEAR_TIE, excused, same
from league.spaces import Box, Discrete, MultiDiscrete

BOX = Box(dtype="float32", shape=(2,), low=-1, high=1)


def test_discrete_actions_must_be_equal() -> None:
    assert same(np.array([0, 1, 2]), np.array([0, 2, 2]), Discrete(n=3)).tolist() == [True, False, True]


def test_a_near_tie_is_excused() -> None:
    logits = np.array([[1, 1 + NEAR_TIE / 2, 0], [1, 2, 0], [1, 2, 0]])
    actions, expected = np.array([0, 0, 1]), np.array([1, 1, 1])
    assert excused(actions, expected, logits, Discrete(n=3)).tolist() == [True, False, True]
    assert same(actions, expected, Discrete(n=3)).tolist() == [False, False, True]


def test_each_component_of_a_multidiscrete_action_counts() -> None:
    space = MultiDiscrete(nvec=[2, 2], start=[0, 0], shape=(2,))
    logits = np.array([[0, 0, 0, 1.0]] * 2)
    expected = np.array([[0, 1], [0, 1]])
    assert excused(np.array([[1, 1], [0, 0]]), expected, logits, space).tolist() == [True, False]


def test_box_actions_may_differ_by_a_fraction_of_their_range() -> None:
    expected = np.zeros((3, 2), np.float32)
    actions = np.array([[0, 1e-4], [0, 1e-3], [0, np.nan]], np.float32)
    assert same(actions, expected, BOX).tolist() == [True, False, False]
    assert same(actions, expected, BOX, tolerance=0.01).tolist() == [True, True, False]
    assert excused(actions, expected, np.zeros((3, 4)), BOX).tolist() == [True, False, False]
