from typing import Any

import pytest

from league.errors import ConfigError
from league.interface import AgentInterface, Interface
from league.spaces import Box, Discrete
from training.learners.qmix import teams

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


@pytest.mark.parametrize(
    ("groups", "message"),
    [
        ({"red": ("red_*",)}, r"training\.groups: agent 'blue_0' matches none of red"),
        ({"all": ("*",), "green": ("green_*",)}, r"training\.groups\.green: matches no agent"),
    ],
)
def test_groups_that_do_not_partition_the_agents_are_rejected(groups: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        teams(groups, interface())


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
