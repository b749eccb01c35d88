"""Targets of a team, by hand: who has terminated is worth nothing any more, who was truncated could have gone on."""

import pytest
import torch
from torch import Tensor

from training.learners.team_targets import TeamSteps
from training.modules.mixer import summed, unmixed


def steps(**changed: object) -> TeamSteps:
    """Four transitions of two agents: both go on; the second terminates; one terminates and one is truncated; both
    terminate. In a fifth, only the first agent was there, and goes on."""
    fields: dict[str, object] = {
        "rewards": torch.tensor([[1.0, 3.0], [2.0, 0.0], [0.0, 4.0], [-2.0, 2.0], [6.0, 0.0]]),
        "present": torch.tensor([[1, 1], [1, 1], [1, 1], [1, 1], [1, 0]], dtype=torch.bool),
        "terminated": torch.tensor([[0, 0], [0, 1], [1, 0], [1, 1], [0, 0]], dtype=torch.bool),
        "discounts": torch.tensor([0.5, 0.5, 0.25, 0.5, 0.5]),
        "states": torch.zeros(5, 1),
        "next_states": torch.ones(5, 1),
        "together": True,
    }
    return TeamSteps(**(fields | changed))  # type: ignore[arg-type]


FOLLOWING = torch.tensor([[10.0, 20.0]]).expand(5, 2)


def test_targets_of_a_sum_by_hand() -> None:
    found = steps().targets(summed, FOLLOWING)
    expected = [2 + 0.5 * 30, 1 + 0.5 * 10, 2 + 0.25 * 20, 0.0, 3 + 0.5 * 10]
    assert found.squeeze(-1).tolist() == expected
    assert steps().counted().squeeze(-1).tolist() == [True] * 5


def test_a_mixers_own_offset_is_not_added_behind_the_end() -> None:
    """A mixer of nothing but zeros may still answer something, by the state."""

    def offset(values: Tensor, states: Tensor) -> Tensor:
        return values.sum(-1, keepdim=True) + 100 * states

    found = steps().targets(offset, FOLLOWING).squeeze(-1)
    assert found[3] == 0.0
    assert found[0] == 2 + 0.5 * 130


def test_each_by_itself_has_its_own_rewards_and_ends() -> None:
    found = steps(together=False).targets(unmixed, FOLLOWING)
    assert found.tolist() == [[6, 13], [7, 0], [0, 9], [-2, 2], [11, 0]]
    assert steps(together=False).counted()[4].tolist() == [True, False]


def test_who_is_not_there_is_nothing_in_the_mixture() -> None:
    values = torch.tensor([[1.0, 1e6]]).expand(5, 2)
    assert steps().mixed(summed, values)[4].tolist() == [1.0]


def test_nobody_counts_where_nobody_was() -> None:
    absent = steps(present=torch.zeros(5, 2, dtype=torch.bool))
    assert not absent.counted().any()


@pytest.mark.parametrize("together", [True, False])
def test_truncation_taken_for_termination_would_be_seen(together: bool) -> None:
    mixer = summed if together else unmixed
    wrong = steps(together=together, terminated=torch.tensor([[0, 0], [0, 1], [1, 1], [1, 1], [0, 0]]).bool())
    right = steps(together=together)
    assert not torch.equal(right.targets(mixer, FOLLOWING), wrong.targets(mixer, FOLLOWING))
