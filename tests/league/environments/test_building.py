from typing import Any

import pytest

from league.config import LeagueConfig
from league.environments.building import build, interface
from league.errors import ConfigError, EnvironmentMismatch

COUNTING = "tests.league.environments.counting:counting"


def league(entry_point: str = COUNTING, **changes: Any) -> LeagueConfig:
    environment = {"entry_point": entry_point} | changes.pop("environment", {})
    return LeagueConfig.from_mapping({"league": "mini", "environment": environment} | changes)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (league("pettingzoo.classic.connect_for_v3"), "cannot import"),
        (league("pettingzoo.classic"), "has no 'env'"),
        (league("league.config:nothing"), "has no 'nothing'"),
        (league(".relative"), "names no module"),
        (league("builtins:dict"), "expected a PettingZoo AECEnv"),
        (league(environment={"kwargs": {"colour": 1}}), "does not take them"),
        (league(environment={"wrappers": ["frame_stack_v9"]}), "no wrapper 'frame_stack_v9'"),
        (league(environment={"wrappers": ["gymnasium"]}), "no wrapper 'gymnasium'"),
        (league(environment={"wrappers": [{"frame_stack_v1": {"size": 2}}]}), "frame_stack_v1"),
    ],
)
def test_an_environment_that_cannot_be_built_names_the_key(config: LeagueConfig, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        build(config.environment)


def test_by_default_each_agent_is_a_side_and_all_share_a_policy() -> None:
    described = interface(LeagueConfig.load("configs/connect_four.yaml"))
    assert list(described.agents) == ["player_0", "player_1"]
    assert described.policies == {"player_0": "shared", "player_1": "shared"}
    assert described.sides == {"player_0": ("player_0",), "player_1": ("player_1",)}


def test_agents_are_divided_by_pattern_first_match_first() -> None:
    config = league(
        environment={"kwargs": {"lives": [1, 1, 1]}},
        policies={"first": ["player_0"], "second": ["player_1"], "third": ["*"]},
        sides={"alone": ["player_1"], "team": ["player_*"]},
    )
    described = interface(config)
    assert described.policies == {"player_0": "first", "player_1": "second", "player_2": "third"}
    assert described.sides == {"alone": ("player_1",), "team": ("player_0", "player_2")}
    assert described.policy_ids == ("first", "second", "third")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"policies": {"a": ["player_0"]}}, "agent 'player_1' fits none of a"),
        ({"policies": {"a": ["*"], "b": ["player_1"]}}, "policies.b: fits no agent"),
        ({"sides": {"a": ["player_9"]}}, "agent 'player_0' fits none"),
        ({"policies": {"a": ["*"]}}, "player_0 and player_1 have different spaces"),
    ],
)
def test_policies_and_sides_that_do_not_fit_are_refused(changes: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        interface(league(**changes))


def test_an_environment_without_possible_agents_is_refused() -> None:
    with pytest.raises(EnvironmentMismatch, match="possible_agents"):
        interface(league("tests.league.environments.test_building:nameless"))


def nameless() -> Any:
    env = build(league().environment)
    del env.possible_agents
    return env


def test_the_interface_digest_moves_with_spaces_and_policy_ids_alone() -> None:
    one = interface(LeagueConfig.load("configs/connect_four.yaml"))
    text = LeagueConfig.load("configs/connect_four.yaml").model_dump(mode="json", by_alias=True)
    renamed = interface(LeagueConfig.from_mapping(text | {"policies": {"other": ["*"]}}))
    sided = interface(LeagueConfig.from_mapping(text | {"sides": {"x": ["player_0"], "y": ["player_1"]}}))
    assert one.digest() == sided.digest()
    assert one.digest() != renamed.digest()
