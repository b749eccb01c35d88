"""Environments from configurations: their policies and sides, and what cannot be built."""

from typing import Any

import pytest
from pettingzoo import AECEnv, ParallelEnv

from league.config.environment import EnvironmentConfig
from league.config.league import LeagueConfig
from league.environments.building import Cycle, build, describe_policies, divide, interface
from league.errors import ConfigError, EnvironmentMismatch
from tests.support.environments import engines

COUNTING = "tests.support.environments.counting:counting"


def league(entry_point: str = COUNTING, **changes: Any) -> LeagueConfig:
    environment = {"entry_point": entry_point} | changes.pop("environment", {})
    return LeagueConfig.from_mapping({"league": "mini", "environment": environment} | changes)


def test_by_default_each_agent_is_a_side_and_all_share_a_policy() -> None:
    described = interface(LeagueConfig.load("policy_league/configs/connect_four.yaml"))
    assert list(described.agents) == ["player_0", "player_1"]
    assert described.policies == {"player_0": "shared", "player_1": "shared"}
    assert described.sides == {"player_0": ("player_0",), "player_1": ("player_1",)}


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


def test_a_name_matches_before_any_pattern() -> None:
    """Also if it is a pattern for other agents, or none for itself."""
    names = ["drone[3]", "drone3", "drone[3]_0", "a*", "ab", "?"]
    assert divide("sides", {name: (name,) for name in names}, names) == {name: name for name in names}
    groups = {"all": ("*",), "third": ("drone[[]*", "drone3"), "odd": ("a*",)}
    assert divide("policies", groups, ["drone[3]", "drone3", "a*"]) == {
        "drone[3]": "all",
        "drone3": "third",
        "a*": "odd",
    }


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


def test_each_observation_is_computed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    env = build(EnvironmentConfig(entry_point="mpe2.simple_spread_v3"))
    assert isinstance(env, Cycle)
    env.reset(seed=0)
    observed = []
    observe = type(env.unwrapped).observe
    monkeypatch.setattr(
        type(env.unwrapped), "observe", lambda self, agent: observed.append(agent) or observe(self, agent)
    )
    env.step(dict.fromkeys(env.agents, 0))
    assert observed == env.agents


def test_an_environment_that_cannot_be_built_is_reported_with_its_key(subtests: pytest.Subtests) -> None:
    for config, message in (
        (league("pettingzoo.classic.connect_for_v3"), "cannot import"),
        (league("pettingzoo.classic"), "has no 'env'"),
        (league("league.config:nothing"), "has no 'nothing'"),
        (league(".relative"), "is not a valid module name"),
        (league("builtins:dict"), "expected an environment of PettingZoo"),
        (league(environment={"kwargs": {"colour": 1}}), "does not accept them"),
        (league(environment={"wrappers": ["frame_stack_v9"]}), "no wrapper 'frame_stack_v9'"),
        (league(environment={"wrappers": [{"frame_stack_v1": {"size": 2}}]}), "frame_stack_v1"),
        (league(TICTACTOE, environment={"api": "parallel"}), "tictactoe_v3' has no 'parallel_env'"),
        (league(f"{RPS}:env", environment={"api": "rllib"}), "expected an RLlib MultiAgentEnv"),
    ):
        with subtests.test(message=message), pytest.raises(ConfigError, match=message):
            build(config.environment)
    with pytest.raises(EnvironmentMismatch, match="possible_agents"):
        interface(league(f"{__name__}:nameless"))


def test_an_environment_that_cannot_be_wrapped_is_closed() -> None:
    with pytest.raises(ConfigError, match="no wrapper"):
        build(league(f"{engines.__name__}:engine", environment={"wrappers": ["frame_stack_v9"]}).environment)
    assert engines.RUNNING == []


TICTACTOE, RPS, SPREAD = "pettingzoo.classic.tictactoe_v3", "pettingzoo.classic.rps_v2", "mpe2.simple_spread_v3"


def test_mismatched_policies_sides_and_names_are_rejected(subtests: pytest.Subtests) -> None:
    for entry_point, changes, message in (
        (COUNTING, {"policies": {"a": ["player_0"]}}, "agent 'player_1' matches none of a"),
        (COUNTING, {"policies": {"a": ["*"], "b": ["player_?"]}}, "policies.b: matches no agent"),
        (COUNTING, {"sides": {"a": ["player_9"]}}, "agent 'player_0' matches none"),
        (COUNTING, {"policies": {"a": ["*"]}}, "player_0 and player_1 have different spaces"),
        (RPS, {"policies": f"{__name__}:missing"}, "returned no valid policy id for agent 'player_1'"),
        (RPS, {"policies": f"{__name__}:invalid_id"}, "no valid policy id for agent 'player_0'.*Not A Slug"),
        (RPS, {"policies": f"{__name__}:absent"}, "policies: .* has no 'absent'"),
        (RPS, {"policies": "no_such_module:role"}, "policies: cannot import 'no_such_module'"),
        (SPREAD, {"play": {"action_names": ["a", "b"]}}, "policy shared has 5 actions, but 2 names"),
        (SPREAD, {"play": {"action_names": {"shared": ["a"]}}}, "policy shared has 5 actions, but 1 names"),
        (SPREAD, {"play": {"action_names": {"other": ["a"]}}}, r"play.action_names.other: expected .* \(shared\)"),
        ("pettingzoo.sisl.multiwalker_v9", {"play": {"action_names": ["a"]}}, "no policy has Discrete actions"),
    ):
        with subtests.test(message=message), pytest.raises(ConfigError, match=message):
            interface(league(entry_point, **changes))


def role(agent: str) -> str:
    return "even" if agent == "player_0" else "odd"


def missing(agent: str) -> str:
    return {"player_0": "first"}[agent]


def invalid_id(agent: str) -> str:
    return "Not A Slug"


def test_policies_are_assigned_by_a_function_or_by_spaces(subtests: pytest.Subtests) -> None:
    assert interface(league(RPS, policies=f"{__name__}:role")).policies == {"player_0": "even", "player_1": "odd"}
    equal = interface(league(RPS))
    assert equal.policy_ids == ("shared",)
    assert describe_policies(equal) == "Policy: shared (player_0, player_1)."
    adversaries = [f"adversary_{number}" for number in range(3)]
    for name, kinds in {
        "simple_adversary_v3": {"adversary": adversaries[:1], "agent": ["agent_0", "agent_1"]},
        "simple_crypto_v3": {"eve": ["eve_0"], "bob": ["bob_0", "alice_0"]},
        "simple_push_v3": {"adversary": adversaries[:1], "agent": ["agent_0"]},
        "simple_speaker_listener_v4": {"speaker": ["speaker_0"], "listener": ["listener_0"]},
        "simple_tag_v3": {"adversary": adversaries, "agent": ["agent_0"]},
        "simple_world_comm_v3": {
            "leadadversary": ["leadadversary_0"],
            "adversary": adversaries,
            "agent": ["agent_0", "agent_1"],
        },
    }.items():
        with subtests.test(name):
            expected = {agent: policy for policy, agents in kinds.items() for agent in agents}
            assert interface(league(f"mpe2.{name}")).policies == expected


def test_the_api_is_inferred_or_configured() -> None:
    for entry_point, api, expected in (
        (RPS, None, ParallelEnv),
        (RPS, "aec", AECEnv),
        (RPS, "parallel", ParallelEnv),
        (TICTACTOE, None, AECEnv),
        (f"{RPS}:parallel_env", None, ParallelEnv),
    ):
        assert isinstance(build(EnvironmentConfig(entry_point=entry_point, api=api)), expected)
