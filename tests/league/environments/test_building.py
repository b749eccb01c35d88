from typing import Any

import pytest
from pettingzoo import AECEnv, ParallelEnv

from league.config.environment import EnvironmentConfig
from league.config.league import LeagueConfig
from league.environments.building import (
    build,
    describe_policies,
    interface,
)
from league.errors import ConfigError, EnvironmentMismatch

COUNTING = "tests.support.environments.counting:counting"


def league(entry_point: str = COUNTING, **changes: Any) -> LeagueConfig:
    environment = {"entry_point": entry_point} | changes.pop("environment", {})
    return LeagueConfig.from_mapping({"league": "mini", "environment": environment} | changes)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (league("pettingzoo.classic.connect_for_v3"), "cannot import"),
        (league("pettingzoo.classic"), "has no 'env'"),
        (league("league.config:nothing"), "has no 'nothing'"),
        (league(".relative"), "is not a valid module name"),
        (league("builtins:dict"), "expected an environment of PettingZoo"),
        (league(environment={"kwargs": {"colour": 1}}), "does not accept them"),
        (league(environment={"wrappers": ["frame_stack_v9"]}), "no wrapper 'frame_stack_v9'"),
        (league(environment={"wrappers": ["gymnasium"]}), "no wrapper 'gymnasium'"),
        (league(environment={"wrappers": [{"frame_stack_v1": {"size": 2}}]}), "frame_stack_v1"),
    ],
)
def test_an_environment_that_cannot_be_built_is_reported_with_its_key(config: LeagueConfig, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        build(config.environment)


def test_by_default_each_agent_is_a_side_and_all_share_a_policy() -> None:
    found = interface(LeagueConfig.load("policy_league/configs/connect_four.yaml"))
    assert list(found.agents) == ["player_0", "player_1"]
    assert found.policies == {"player_0": "shared", "player_1": "shared"}
    assert found.sides == {"player_0": ("player_0",), "player_1": ("player_1",)}


def test_agents_are_matched_by_pattern_in_order() -> None:
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
        ({"policies": {"a": ["player_0"]}}, "agent 'player_1' matches none of a"),
        ({"policies": {"a": ["*"], "b": ["player_1"]}}, "policies.b: matches no agent"),
        ({"sides": {"a": ["player_9"]}}, "agent 'player_0' matches none"),
        ({"policies": {"a": ["*"]}}, "player_0 and player_1 have different spaces"),
    ],
)
def test_mismatched_policies_and_sides_are_rejected(changes: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        interface(league(**changes))


def test_an_environment_without_possible_agents_is_rejected() -> None:
    with pytest.raises(EnvironmentMismatch, match="possible_agents"):
        interface(league("tests.league.environments.test_building:nameless"))


def nameless() -> Any:
    env = build(league().environment)
    del env.possible_agents
    return env


def test_the_interface_digest_depends_on_spaces_and_policy_ids_only() -> None:
    one = interface(LeagueConfig.load("policy_league/configs/connect_four.yaml"))
    text = LeagueConfig.load("policy_league/configs/connect_four.yaml").model_dump(mode="json", by_alias=True)
    renamed = interface(LeagueConfig.from_mapping(text | {"policies": {"other": ["*"]}}))
    sided = interface(LeagueConfig.from_mapping(text | {"sides": {"x": ["player_0"], "y": ["player_1"]}}))
    assert one.digest() == sided.digest()
    assert one.digest() != renamed.digest()


def role(agent: str) -> str:
    return "even" if agent == "player_0" else "odd"


def missing(agent: str) -> str:
    return {"player_0": "first"}[agent]


def invalid_id(agent: str) -> str:
    return "Not A Slug"


def test_policies_can_be_assigned_by_a_function() -> None:
    config = LeagueConfig.from_mapping(
        {"league": "x", "environment": {"entry_point": "pettingzoo.classic.rps_v2"}, "policies": f"{__name__}:role"}
    )
    assert interface(config).policies == {"player_0": "even", "player_1": "odd"}


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (f"{__name__}:missing", "returned no valid policy id for agent 'player_1'"),
        (f"{__name__}:invalid_id", "returned no valid policy id for agent 'player_0'.*Not A Slug"),
        (f"{__name__}:absent", "policies: .* has no 'absent'"),
        ("no_such_module:role", "policies: cannot import 'no_such_module'"),
    ],
)
def test_a_function_without_a_valid_policy_id_is_rejected(function: str, message: str) -> None:
    config = LeagueConfig.from_mapping(
        {"league": "x", "environment": {"entry_point": "pettingzoo.classic.rps_v2"}, "policies": function}
    )
    with pytest.raises(ConfigError, match=message):
        interface(config)


@pytest.mark.parametrize(
    ("entry_point", "api", "expected"),
    [
        ("pettingzoo.classic.rps_v2", None, ParallelEnv),
        ("pettingzoo.classic.rps_v2", "aec", AECEnv),
        ("pettingzoo.classic.rps_v2", "parallel", ParallelEnv),
        ("pettingzoo.classic.tictactoe_v3", None, AECEnv),
        ("pettingzoo.classic.rps_v2:parallel_env", None, ParallelEnv),
    ],
)
def test_the_api_is_inferred_or_configured(entry_point: str, api: str | None, expected: type) -> None:
    assert isinstance(build(EnvironmentConfig(entry_point=entry_point, api=api)), expected)


def test_a_missing_api_is_rejected() -> None:
    with pytest.raises(ConfigError, match=r"tictactoe_v3' has no 'parallel_env'"):
        build(EnvironmentConfig(entry_point="pettingzoo.classic.tictactoe_v3", api="parallel"))
    with pytest.raises(ConfigError, match="expected an RLlib MultiAgentEnv"):
        build(EnvironmentConfig(entry_point="pettingzoo.classic.rps_v2:env", api="rllib"))


def test_wrappers_in_an_impossible_order_are_rejected() -> None:
    wrappers = ["flatten_v0", {"resize_v1": {"x_size": 8, "y_size": 8}}]
    config = EnvironmentConfig(entry_point="pettingzoo.sisl.pursuit_v5", wrappers=wrappers)
    with pytest.raises(ConfigError, match=r"resize_v1 \(number 2\).*before it"):
        build(config)


def test_supersuit_does_not_wrap_rllib_environments() -> None:
    config = EnvironmentConfig(entry_point="policy_league.examples.traffic:crossing", wrappers=["flatten_v0"])
    with pytest.raises(ConfigError, match=r"flatten_v0 \(number 1\).*RLlib"):
        build(config)


ENTRY_POINTS_WITH_KINDS = {
    "mpe2.simple_adversary_v3": {"adversary": "adversary_0", "agent": "agent_0 agent_1"},
    "mpe2.simple_crypto_v3": {"eve": "eve_0", "bob": "bob_0 alice_0"},
    "mpe2.simple_push_v3": {"adversary": "adversary_0", "agent": "agent_0"},
    "mpe2.simple_speaker_listener_v4": {"speaker": "speaker_0", "listener": "listener_0"},
    "mpe2.simple_tag_v3": {"adversary": "adversary_0 adversary_1 adversary_2", "agent": "agent_0"},
    "mpe2.simple_world_comm_v3": {
        "leadadversary": "leadadversary_0",
        "adversary": "adversary_0 adversary_1 adversary_2",
        "agent": "agent_0 agent_1",
    },
}


@pytest.mark.parametrize("entry_point", ENTRY_POINTS_WITH_KINDS)
def test_agents_with_different_spaces_get_a_policy_per_kind(entry_point: str) -> None:
    found = interface(LeagueConfig.from_mapping({"league": "x", "environment": {"entry_point": entry_point}}))
    kinds = ENTRY_POINTS_WITH_KINDS[entry_point]
    assert found.policies == {agent: policy for policy, agents in kinds.items() for agent in agents.split()}


def test_agents_with_equal_spaces_share_a_policy() -> None:
    environment = {"entry_point": "pettingzoo.classic.rps_v2"}
    found = interface(LeagueConfig.from_mapping({"league": "x", "environment": environment}))
    assert found.policy_ids == ("shared",)
    assert describe_policies(found) == "Policy: shared (player_0, player_1)."


@pytest.mark.parametrize(
    ("entry_point", "names", "message"),
    [
        ("mpe2.simple_spread_v3", ["a", "b"], "policy shared has 5 actions, but 2 names"),
        ("mpe2.simple_spread_v3", {"shared": ["a"]}, "policy shared has 5 actions, but 1 names"),
        ("mpe2.simple_spread_v3", {"other": ["a"]}, r"play.action_names.other: expected .* \(shared\)"),
        ("pettingzoo.sisl.multiwalker_v9", ["a"], "no policy has Discrete actions"),
    ],
)
def test_action_names_must_fit_the_action_spaces(entry_point: str, names: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        interface(league(entry_point, play={"action_names": names}))


class Changing(AECEnv):
    """It changes its arguments, as RLlib's chess does."""

    def __init__(self, options: dict) -> None:
        options["length"] = options.get("length", 3) + 1
        self.possible_agents = []


def test_an_environment_cannot_change_its_configuration() -> None:
    config = EnvironmentConfig(entry_point=f"{__name__}:Changing", kwargs={"options": {"length": 3}})
    digest = config.digest()
    build(config)
    assert config.kwargs == {"options": {"length": 3}}
    assert config.digest() == digest
