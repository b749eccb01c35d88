"""What is said about an action that cannot be played."""

from typing import Any

import numpy as np
import pytest

from evaluation.matches.policy_calls import PolicyFault, action_fault
from league.policies.policy import Actions
from league.spaces import Box, Discrete, Leaf, MultiBinary, MultiDiscrete

DIRECTIONS = Discrete(n=3, start=4)
PAIR = MultiDiscrete(nvec=[2, 3], start=[0, 1], shape=(2,), dtype="int64")
FORCE = Box(dtype="float32", shape=(2,), low=-1.0, high=2.0)
SWITCHES = MultiBinary(shape=(2,))


@pytest.mark.parametrize(
    ("space", "action", "mask", "fault"),
    [
        (DIRECTIONS, 7, None, ("illegal_action", "action 7, legal: 4 to 6")),
        (DIRECTIONS, 5, [1, 0, 1], ("illegal_action", "action 5, legal: 4, 6")),
        (PAIR, [1, 4], None, ("illegal_action", "action [1, 4], legal: from [0, 1] on, [2, 3] choices")),
        (
            PAIR, [1, 3], [1, 0, 1, 1, 1],
            ("illegal_action", "from [0, 1] on, [2, 3] choices, where action_mask is [1, 0, 1, 1, 1]"),
        ),
        (FORCE, [0.0, 3.0], None, ("illegal_action", "action [0.0, 3.0], legal: from -1.0 to 2.0")),
        (FORCE, [0.0, np.inf], None, ("not_finite", "action [0.0, inf]")),
        (SWITCHES, [0, 2], None, ("illegal_action", "action [0, 2], legal: 0 or 1")),
        (FORCE, [0.5], None, ("malformed", "actions are float64 [1, 1], expected float32 [1, 2]")),
        (DIRECTIONS, 4.0, None, ("malformed", "actions are float64 [1], expected int64 [1]")),
        (DIRECTIONS, 6, [0, 1, 1], None),
        (PAIR, [1, 3], None, None),
    ],
)  # fmt: skip
def test_the_fault_of_an_action(
    space: Leaf, action: Any, mask: list[int] | None, fault: tuple[str, str] | None
) -> None:
    masks = None if mask is None else np.array([mask], np.int8)
    problem = action_fault(Actions(np.array([action])), space, masks)
    if fault is None:
        assert problem is None
    else:
        assert problem is not None
        assert (problem.reason, problem.detail.endswith(fault[1])) == (fault[0], True), problem.detail


def test_a_state_has_a_row_for_each_action() -> None:
    answer = Actions(np.array([4]), {"state_in_0": np.zeros((2, 8), np.float32)})
    assert action_fault(answer, DIRECTIONS, None) == PolicyFault("malformed", "state_in_0 has 2 rows, expected 1")
