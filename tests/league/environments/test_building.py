from typing import Any

import pytest
from gymnasium import spaces
from pettingzoo import AECEnv, ParallelEnv

from league.config import EnvironmentConfig, LeagueConfig
from league.environments.building import action_space, build, describe, interface, observation_space
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
        (league("builtins:dict"), "expected an environment of PettingZoo"),
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


def role(agent: str) -> str:
    return "even" if agent == "player_0" else "odd"


def nobody(agent: str) -> str:
    return {"player_0": "first"}[agent]


def shouting(agent: str) -> str:
    return "Not A Slug"


def test_a_function_says_whose_policy_an_agent_has() -> None:
    config = LeagueConfig.from_mapping(
        {"league": "x", "environment": {"entry_point": "pettingzoo.classic.rps_v2"}, "policies": f"{__name__}:role"}
    )
    assert interface(config).policies == {"player_0": "even", "player_1": "odd"}


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (f"{__name__}:nobody", "gives no policy for agent 'player_1'"),
        (f"{__name__}:shouting", "gives no policy for agent 'player_0'.*Not A Slug"),
        (f"{__name__}:absent", "has no function 'absent'"),
        ("no_such_module:role", "policies: cannot import 'no_such_module'"),
    ],
)
def test_a_function_that_gives_no_policy_is_refused_by_name(function: str, message: str) -> None:
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
def test_the_api_is_inferred_or_asked_for(entry_point: str, api: str | None, expected: type) -> None:
    assert isinstance(build(EnvironmentConfig(entry_point=entry_point, api=api)), expected)


def test_another_api_than_the_one_asked_for_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"tictactoe_v3' has no 'parallel_env'"):
        build(EnvironmentConfig(entry_point="pettingzoo.classic.tictactoe_v3", api="parallel"))
    with pytest.raises(ConfigError, match="expected an RLlib MultiAgentEnv"):
        build(EnvironmentConfig(entry_point="pettingzoo.classic.rps_v2:env", api="rllib"))


def test_wrappers_in_an_impossible_order_are_refused_with_their_place_and_what_is_before_them() -> None:
    wrappers = ["flatten_v0", {"resize_v1": {"x_size": 8, "y_size": 8}}]
    config = EnvironmentConfig(entry_point="pettingzoo.sisl.pursuit_v5", wrappers=wrappers)
    with pytest.raises(ConfigError, match=r"resize_v1 \(number 2\).*before it"):
        build(config)


def test_supersuit_does_not_wrap_rllibs_environments() -> None:
    config = EnvironmentConfig(entry_point="examples.traffic:crossing", wrappers=["flatten_v0"])
    with pytest.raises(ConfigError, match=r"flatten_v0 \(number 1\).*RLlib"):
        build(config)


class OneSpaceForAll:
    """RLlib's older way: no dictionary of spaces."""

    possible_agents = ("agent_0", "agent_1")

    def __init__(self, space: Any) -> None:
        self.observation_space = self.action_space = space
        self.observation_spaces = self.action_spaces = None

    def reset(self) -> None: ...

    def step(self) -> None: ...


def test_rllibs_spaces_are_found_in_each_of_its_forms() -> None:
    one, other = spaces.Discrete(3), spaces.Discrete(4)
    assert observation_space(OneSpaceForAll(one), "agent_1") == one
    assert action_space(OneSpaceForAll(spaces.Dict(agent_0=one, agent_1=other)), "agent_1") == other
    with pytest.raises(EnvironmentMismatch, match="no action_space for agent 'agent_1'"):
        action_space(OneSpaceForAll(None), "agent_1")


def test_agents_without_names_are_refused() -> None:
    env = OneSpaceForAll(spaces.Discrete(3))
    env.possible_agents = (0, 1)  # type: ignore[assignment]
    with pytest.raises(EnvironmentMismatch, match="expected names, not numbers"):
        describe(env, league())
