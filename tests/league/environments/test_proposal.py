"""Proposed configurations: what agents, spaces and measured play decide."""

from pathlib import Path
from typing import Any

import pytest
import yaml

from league.config.environment import EnvironmentConfig
from league.environments.building import divide
from league.environments.conformance.findings import Examination
from league.environments.conformance.openings import OpeningMeasurement
from league.environments.conformance.proposal import _inline, _text, propose
from league.errors import ConfigError
from league.interface import AgentInterface, Interface
from league.spaces import Box, DictSpace, Discrete, MultiDiscrete
from tests.support.leagues.registries import config

THREE = Discrete(n=3)


def spaces(action: Any = THREE, shape: tuple[int, ...] = (4,), low: Any = -1, high: Any = 1) -> AgentInterface:
    observation = Box(dtype="float32", shape=shape, low=low, high=high)
    return AgentInterface(observation=DictSpace(spaces={"observation": observation}), action=action)


def interface(*kinds: AgentInterface, hidden: bool = False) -> Interface:
    agents = {f"player_{number}": kind for number, kind in enumerate(kinds)}
    return Interface(
        agents=agents,
        policies={agent: f"policy_{kinds.index(kind)}" for agent, kind in agents.items()},
        sides={agent: (agent,) for agent in agents},
        hidden_information=hidden,
    )


def examined(api: str = "AEC", actions: int | None = 100) -> Examination:
    openings = OpeningMeasurement(1, 20, (), 3)
    return Examination(api=api, actions_per_episode=actions, openings=openings)


def proposed(
    examination: Examination, described: Interface, *, is_team: bool = False, environment: Any = None
) -> tuple[Any, list[str]]:
    """The document of a file, and its lines."""
    league = config()
    if environment is not None:
        league = league.model_copy(update={"environment": EnvironmentConfig.model_validate(environment)})
    text = _text(league, examination, described, is_team, None)
    lines = text.splitlines()
    assert all(" # " in line for line in lines[1:] if line)
    return yaml.safe_load(text), lines


def training(examination: Examination, *kinds: AgentInterface, hidden: bool = False) -> Any:
    return proposed(examination, interface(*kinds, hidden=hidden))[0]["training"]


def test_the_network_fits_the_observations() -> None:
    assert "convolutions" not in training(examined(), spaces(), spaces())
    assert "convolutions" not in training(examined(), spaces(shape=(3, 3, 2)))
    assert training(examined(), spaces(shape=(6, 7, 2)))["convolutions"] == [{"filters": 32, "kernel": 3}]
    assert len(training(examined(), spaces(shape=(84, 84, 3), low=0, high=255))["convolutions"]) == 3
    assert len(training(examined(), spaces(shape=(84, 84, 3)), spaces(shape=(8, 8, 3)))["convolutions"]) == 1
    settings = training(examined(), spaces(shape=(4, 84, 84), low=0, high=255))
    assert (settings["channels"], len(settings["convolutions"])) == ("first", 3)
    assert training(examined(), spaces(shape=(84, 84, 4), low=0, high=255))["channels"] == "last"
    mixed = training(examined(), spaces(shape=(84, 84, 3)), spaces(shape=(3, 84, 84)))
    assert ("channels" in mixed, len(mixed["convolutions"])) == (False, 3)
    assert "normalize_observations" not in training(examined(), spaces(low=-1, high=1))
    for low, high in ((None, None), (0, 1000), (0, None), ([0, 0, 0, None], 1)):
        assert training(examined(), spaces(low=low, high=high))["normalize_observations"] is True


def test_values_survive_yaml(tmp_path: Path) -> None:
    for value in ("a.b:c", "yes", "a: b", "..", "#", "", "a'b\"", {"game": "x", "n": [1, True]}, [None]):
        assert yaml.safe_load(f"key: {_inline(value)}  # comment") == {"key": value}
    for game in ("kuhn_poker", "a  # b"):
        environment = {"entry_point": "openspiel", "kwargs": {"game": game}}
        document, _ = proposed(examined(), interface(spaces(), spaces()), environment=environment)
        assert (document["league"], document["environment"]) == ("tictactoe", environment)
    with pytest.raises(ConfigError, match="nowhere_to_be_found"):
        propose("mine", "nowhere_to_be_found:make_env", {}, str(tmp_path))


def test_the_algorithm_fits_the_actions() -> None:
    box = Box(dtype="float32", shape=(2,), low=-1, high=1)
    for api, action, remark in (
        ("AEC", Discrete(n=3), "also possible: dqn"),
        ("Parallel", Discrete(n=3), "also possible: dqn, qmix (a team), maddpg"),
        ("Parallel", box, "also possible: maddpg"),
        ("AEC", box, "the only one for these spaces"),
        ("Parallel", MultiDiscrete(nvec=[2, 3], start=[0, 0], shape=(2,)), "the only one for these spaces"),
    ):
        _, lines = proposed(examined(api), interface(spaces(action), spaces(action)))
        assert next(line for line in lines if "algorithm: ppo" in line).endswith(remark)


def test_episodes_and_hidden_information_decide_discount_and_annealing() -> None:
    for actions in (1, 5, 6, 100, None):
        _, lines = proposed(examined(actions=actions), interface(spaces(), spaces()))
        line = next(line for line in lines if "gamma" in line)
        is_short = actions in (1, 5)
        assert yaml.safe_load(line) == {"gamma": 1.0 if is_short else 0.99}
        assert (f"no discount: at most {actions} action" in line) == is_short, line
    open_, hidden = (training(examined(), spaces(), spaces(), hidden=value) for value in (False, True))
    assert (open_["gamma"], open_["lr"]) == (0.99, 0.0005)
    assert hidden["lr"] == {"initial": 0.001, "final": 0.0}


def test_measured_openings_are_used_unless_actions_are_sampled() -> None:
    open_play = proposed(examined(), interface(spaces(), spaces()))[0]["play"]
    hidden = proposed(examined(), interface(spaces(), spaces(), hidden=True))[0]["play"]
    team = proposed(examined(), interface(spaces(), spaces(), hidden=True), is_team=True)[0]["play"]
    assert open_play == {"actions": "greedy", "opening_plies": 3}
    assert hidden == {"actions": "sampled", "opening_plies": 0}
    assert team == {"actions": "greedy", "opening_plies": 3}


def test_policies_and_sides() -> None:
    two = interface(spaces(), spaces(Discrete(n=5)))
    document, _ = proposed(examined(), two)
    assert document["policies"] == {"policy_0": ["player_0"], "policy_1": ["player_1"]}
    assert document["sides"] == {"player_0": ["player_0"], "player_1": ["player_1"]}
    many = interface(*[spaces()] * 9, *[spaces(Discrete(n=5))] * 9)
    document, _ = proposed(examined(), many)
    assert document["policies"]["policy_0"] == [f"player_{number}" for number in range(9)], "a pattern fits others"
    assert document["sides"] is None
    assert proposed(examined(), many, is_team=True)[0]["sides"] == {"team": ["*"]}


def test_a_pattern_fits_agents_with_brackets() -> None:
    names = {"few": ["gate"], "many": [f"unit[a]_{number}" for number in range(9)]}
    policies = {agent: policy for policy, agents in names.items() for agent in agents}
    described = Interface(
        agents={agent: spaces() for agent in policies},
        policies=policies,
        sides={agent: (agent,) for agent in policies},
    )
    patterns = proposed(examined(), described)[0]["policies"]
    assert patterns == {"few": ["gate"], "many": ["unit[[]a]_*"]}
    assert divide("policies", patterns, list(policies)) == policies
