import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from evaluation.matches.match_recorder import ActionLog


@given(st.permutations(range(4)), st.integers(1, 5), st.integers(0, 7))
def test_actions_are_recorded_by_step_and_agent_for_any_batches(order: list[int], steps: int, opening: int) -> None:
    """Two episodes, whose agents act in any order; the second one is recorded without its last step."""
    log = ActionLog()
    episodes = np.array([3, 5])
    for step in range(steps):
        for agent in order:
            actions = 100 * episodes + 10 * step + agent
            log.add(episodes, np.array([step, step]), np.array([agent, agent]), actions)
    found = log.of(np.array([5, 3]), np.array([steps - 1, steps]), opening)
    for own, episode, counted in zip(found, (5, 3), (steps - 1, steps), strict=True):
        expected = [100 * episode + 10 * step + agent for step in range(counted) for agent in range(4)]
        cut = 4 * min(opening, counted)
        assert own == (tuple(expected[:cut]), tuple(expected[cut:]))


def test_an_episode_without_actions_is_empty() -> None:
    assert ActionLog().of(np.array([0]), np.array([0]), 2) == [((), ())]
