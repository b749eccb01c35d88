"""Targets of a team, by hand: termination ends the return, truncation bootstraps."""

import pytest
import torch
from torch import Tensor

from training.learners.qmix import TeamSteps
from training.modules.qmix import independent_mixer, vdn_mixer


def steps(**changed: object) -> TeamSteps:
    """Four transitions of two agents: both continue; the second terminates; one terminates and one is truncated; both
    terminate. In a fifth, only the first agent is present, and continues.
    """
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


def test_targets_of_a_sum() -> None:
    found = steps().targets(vdn_mixer, FOLLOWING)
    expected = [2 + 0.5 * 30, 1 + 0.5 * 10, 2 + 0.25 * 20, 0.0, 3 + 0.5 * 10]
    assert found.squeeze(-1).tolist() == pytest.approx(expected)
    assert steps().counted().squeeze(-1).tolist() == [True] * 5


def test_the_offset_of_a_mixer_is_not_added_after_the_end() -> None:
    """A mixer may have an offset that depends on the state."""

    def offset(values: Tensor, states: Tensor) -> Tensor:
        return values.sum(-1, keepdim=True) + 100 * states

    found = steps().targets(offset, FOLLOWING).squeeze(-1)
    assert found[[3, 0]].tolist() == pytest.approx([0.0, 2 + 0.5 * 130])


def test_independent_agents_have_their_own_rewards_and_endings() -> None:
    found = steps(together=False).targets(independent_mixer, FOLLOWING)
    assert found.flatten().tolist() == pytest.approx([6, 13, 7, 0, 0, 9, -2, 2, 11, 0])
    assert steps(together=False).counted()[4].tolist() == [True, False]


def test_absent_agents_are_not_mixed() -> None:
    values = torch.tensor([[1.0, 1e6]]).expand(5, 2)
    assert steps().mixed(vdn_mixer, values)[4].tolist() == pytest.approx([1.0])


def test_steps_without_agents_are_not_counted() -> None:
    absent = steps(present=torch.zeros(5, 2, dtype=torch.bool))
    assert not absent.counted().any()


@pytest.mark.parametrize("together", [True, False])
def test_treating_truncation_as_termination_changes_the_targets(together: bool) -> None:
    mixer = vdn_mixer if together else independent_mixer
    terminated_instead = steps(
        together=together, terminated=torch.tensor([[0, 0], [0, 1], [1, 1], [1, 1], [0, 0]]).bool()
    )
    correct = steps(together=together)
    assert not torch.equal(correct.targets(mixer, FOLLOWING), terminated_instead.targets(mixer, FOLLOWING))
