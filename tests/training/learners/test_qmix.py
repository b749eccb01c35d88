"""Targets of a team, by hand: termination ends the return, truncation bootstraps."""

from typing import Any

import pytest
import torch
from torch import Tensor

from league.errors import ConfigError
from league.interface import AgentInterface, Interface
from league.spaces import Box, Discrete
from training.learners.qmix import TeamSteps, teams
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
    targets = steps().targets(vdn_mixer, FOLLOWING).squeeze(-1)
    assert targets.tolist() == pytest.approx([2 + 0.5 * 30, 1 + 0.5 * 10, 2 + 0.25 * 20, 0.0, 3 + 0.5 * 10])
    assert steps().counted().squeeze(-1).tolist() == [True] * 5


def test_the_offset_of_a_mixer_is_not_added_after_the_end() -> None:
    def offset(values: Tensor, states: Tensor) -> Tensor:
        return values.sum(-1, keepdim=True) + 100 * states

    targets = steps().targets(offset, FOLLOWING).squeeze(-1)
    assert targets[[3, 0]].tolist() == pytest.approx([0.0, 2 + 0.5 * 130])


def test_independent_agents_have_their_own_rewards_and_endings() -> None:
    targets = steps(together=False).targets(independent_mixer, FOLLOWING)
    assert targets.flatten().tolist() == pytest.approx([6, 13, 7, 0, 0, 9, -2, 2, 11, 0])
    assert steps(together=False).counted()[4].tolist() == [True, False]


def test_absent_agents_are_not_mixed() -> None:
    values = torch.tensor([[1.0, 1e6]]).expand(5, 2)
    assert steps().mixed(vdn_mixer, values)[4].tolist() == pytest.approx([1.0])


def test_steps_without_agents_are_not_counted() -> None:
    assert not steps(present=torch.zeros(5, 2, dtype=torch.bool)).counted().any()


OBSERVATION_SPACE = Box(dtype="float32", shape=(3,), low=None, high=None)


def interface(*, actions: dict[str, Any] | None = None, observations: dict[str, Any] | None = None) -> Interface:
    names = ["red_0", "red_1", "blue_0"]
    return Interface(
        agents={
            name: AgentInterface(
                observation=(observations or {}).get(name, OBSERVATION_SPACE),
                action=(actions or {}).get(name, Discrete(n=2)),
            )
            for name in names
        },
        policies={name: name for name in names},
        sides={"red": ("red_1", "red_0"), "blue": ("blue_0",)},
    )


def test_teams_are_the_sides_or_the_groups() -> None:
    assert teams(None, interface()) == {"red": ("red_0", "red_1"), "blue": ("blue_0",)}
    assert teams({"all": ("*",)}, interface()) == {"all": ("red_0", "red_1", "blue_0")}
    assert teams({"first": ("*_0",), "rest": ("*",)}, interface()) == {"first": ("red_0", "blue_0"), "rest": ("red_1",)}


def test_groups_that_do_not_partition_the_agents_are_rejected() -> None:
    with pytest.raises(ConfigError, match=r"training\.groups: agent 'blue_0' matches none of red"):
        teams({"red": ("red_*",)}, interface())
    with pytest.raises(ConfigError, match=r"training\.groups\.green: matches no agent"):
        teams({"all": ("*",), "green": ("green_*",)}, interface())


def test_a_team_requires_equal_spaces_and_discrete_actions() -> None:
    continuous = Box(dtype="float32", shape=(1,), low=-1, high=1)
    with pytest.raises(ConfigError, match=r"sides\.red: qmix needs Discrete actions, but red_0 has .*maddpg"):
        teams(None, interface(actions={"red_0": continuous}))
    with pytest.raises(ConfigError, match=r"red_0 and red_1 have different action spaces: pad .* pad_action_space_v0"):
        teams(None, interface(actions={"red_1": Discrete(n=3)}))
    with pytest.raises(
        ConfigError, match=r"different observation spaces: pad them with SuperSuit's pad_observations_v0"
    ):
        teams(None, interface(observations={"red_1": Box(dtype="float32", shape=(4,), low=None, high=None)}))
    # Other teams may have other spaces.
    assert teams(None, interface(actions={"blue_0": Discrete(n=3)}))
