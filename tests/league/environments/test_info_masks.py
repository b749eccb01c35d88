"""Which keys of a Dict observation are the mask, and which are observed; masks in infos join the observations."""

import re
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from pettingzoo.classic import tictactoe_v3

from league.config.environment import EnvironmentConfig
from league.config.league import LeagueConfig
from league.environments.building import build, interface
from league.environments.conformance.examination import examine
from league.environments.implementation import stock_stepping
from league.environments.stepping import each_agent_alone
from league.errors import EnvironmentMismatch, IllegalAction
from league.spaces import ACTION_MASK, OBSERVATION, DictSpace, inputs
from tests.conformance.stepping import assert_stepping_conforms
from tests.support.environments import masked
from tests.support.environments.masked import ACTIONS, AGENTS, APIS, BOX, ParallelMasked, RLlibMasked


def masked_league(api: str, space: str, **kwargs: Any) -> LeagueConfig:
    environment = {"entry_point": f"{masked.__name__}:{api}", "kwargs": {"space": space, **kwargs}}
    return LeagueConfig.from_mapping({"league": "masked", "environment": environment})


def test_with_actions_that_cannot_be_masked_the_key_is_observed_like_any_other() -> None:
    config = masked_league("ParallelMasked", "obs", continuous=True)
    assert examine(config, episodes=1).passed
    observation = interface(config).agents["ann"].observation
    assert sorted(inputs(observation)) == ["observation.action_mask", "observation.obs"]
    assert type(observation).model_validate_json(observation.model_dump_json()) == observation


class Far(ParallelMasked):
    """Observes a time in milliseconds since 1970."""

    def __init__(self) -> None:
        super().__init__("obs")

    def value(self, space: Any = None, key: str = "") -> Any:
        value = super().value(space, key)
        return value if space else value | {"obs": np.array([self.rng.uniform(1.7e12, 1.8e12), 0], np.float32)}


class InfoMaskTicTacToe(tictactoe_v3.raw_env):
    """Tic-tac-toe that reports its masks in infos only."""

    def observation_space(self, agent: str) -> spaces.Space:
        return super().observation_space(agent)["observation"]

    def observe(self, agent: str) -> Any:
        observation = super().observe(agent)
        self.infos[agent] = {"action_mask": observation["action_mask"]}
        return observation["observation"]

    def reset(self, seed: int | None = None, options: dict | None = None) -> None:
        super().reset(seed, options)
        for agent in self.agents:
            self.observe(agent)

    def step(self, action: int | None) -> None:
        if action is not None and not self.infos[self.agent_selection]["action_mask"][action]:
            raise ValueError(f"illegal action {action}")
        super().step(action)
        for agent in self.agents:
            self.observe(agent)


def league(environment: type, **kwargs: Any) -> LeagueConfig:
    entry_point = f"{__name__}:{environment.__name__}"
    return LeagueConfig.from_mapping({"league": "masks", "environment": {"entry_point": entry_point, "kwargs": kwargs}})


def test_masks_are_part_of_the_observations() -> None:
    for spaces_of_agent in interface(league(InfoMaskTicTacToe)).agents.values():
        assert isinstance(spaces_of_agent.observation, DictSpace)
        assert set(spaces_of_agent.observation.spaces) == {OBSERVATION, ACTION_MASK}
    examination = examine(league(InfoMaskTicTacToe), episodes=10)
    assert examination.passed, examination.findings
    plain = EnvironmentConfig(entry_point="pettingzoo.classic.rps_v2")
    assert not isinstance(
        interface(LeagueConfig(league="x", environment=plain)).agents["player_0"].observation, DictSpace
    )


def test_episodes_equal_those_of_masks_in_observations() -> None:
    assert_stepping_conforms(
        lambda n: stock_stepping(league(InfoMaskTicTacToe).environment, n), tictactoe_v3.env, list(range(8)), num_envs=4
    )


@pytest.mark.parametrize("api", APIS)
def test_the_mask_counts_whatever_the_other_keys_are_called_and_all_are_observed(
    api: str, subtests: pytest.Subtests
) -> None:
    for space, names in (
        ("obs", ["observation", "action_mask"]),
        ("nested", ["observation.a", "observation.b", "action_mask"]),
        ("secret", ["observation.observation", "observation.secret", "action_mask"]),
        ("multi", ["observation", "action_mask"]),
    ):
        with subtests.test(space=space):
            config = masked_league(api, space)
            examination = examine(config, episodes=1)
            assert examination.passed, examination.findings
            assert list(inputs(interface(config).agents["ann"].observation)) == names
            stepping = stock_stepping(config.environment, 1)
            turn = stepping.start(each_agent_alone([0], 2))
            assert list(turn.batches[0].observations) == names
            illegal = np.array([[0, 1]]) if space in ACTIONS else np.array([1])
            with pytest.raises(IllegalAction, match="action_mask is"):
                stepping.step(dict.fromkeys(turn.batches, illegal))


def test_a_mask_that_does_not_fit_is_refused_with_both_sizes() -> None:
    for space, reason in (
        ("joint", r"action_mask has the shape \[2, 3\], expected \[5\]: one number for each choice of"),
        ("short", r"action_mask has the shape \[2\], expected \[3\]: one number for each action"),
        ("parts", r"action_mask is a Dict, expected \[3\]"),
        ("only", "observations contain only action_mask: expected at least one more key"),
    ):
        with pytest.raises(EnvironmentMismatch, match=f"agent ann: {reason}"):
            interface(masked_league("ParallelMasked", space))


class InfoMasks:
    """Masks in infos only, after reset or only after a step. The observation has two other keys."""

    def __init__(self, late: bool = False) -> None:
        super().__init__(space="obs")  # type: ignore[call-arg]
        self.late = late
        self.observed = spaces.Dict({"obs": BOX, "secret": BOX})
        self.observation_spaces = dict.fromkeys(AGENTS, self.observed)
        self.masks = {agent: {"action_mask": np.array([1, 0, 1])} for agent in AGENTS}

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return super().reset(seed=seed)[0], {} if self.late else self.masks  # type: ignore[misc]

    def step(self, actions: dict[str, Any]) -> Any:
        return *super().step(actions)[:-1], self.masks  # type: ignore[misc]

    def move(self, action: Any) -> None:
        super().move(np.int64(0) if self.late else action)  # type: ignore[misc]


class ParallelInfoMasks(InfoMasks, ParallelMasked): ...


class RLlibInfoMasks(InfoMasks, RLlibMasked): ...


def test_masks_in_infos_may_change_or_be_missing_but_need_the_width_of_the_actions() -> None:
    env = build(league(ParallelInfoMasks).environment)
    masks = env.unwrapped.masks
    del masks["bob"]
    observations, _ = env.reset(seed=1)
    assert observations["bob"][ACTION_MASK].tolist() == [1, 1, 1], "without a mask all actions are legal"
    masks["ann"] = {"action_mask": np.array([1, 0, 0])}
    observations, *_ = env.step(dict.fromkeys(AGENTS, np.int64(0)))
    assert observations["ann"][ACTION_MASK].tolist() == [1, 0, 0]
    masks["ann"] = {"action_mask": np.ones(4)}
    with pytest.raises(EnvironmentMismatch, match=r"'ann' has an action_mask of shape \[4\], expected \[3\]"):
        env.reset(seed=1)


@pytest.mark.parametrize("environment", [ParallelInfoMasks, RLlibInfoMasks])
def test_masks_in_infos_join_observations_with_several_keys(environment: type) -> None:
    config = league(environment)
    examination = examine(config, episodes=1)
    assert examination.passed, examination.findings
    stepping = stock_stepping(config.environment, 1)
    turn = stepping.start(each_agent_alone([0], 2))
    assert list(turn.batches[0].observations) == ["observation.obs", "observation.secret", "action_mask"]
    with pytest.raises(IllegalAction, match=r"action_mask is \[1, 0, 1\]"):
        stepping.step({group: np.array([1]) for group in turn.batches})
    late = examine(league(environment, late=True), episodes=1)
    assert "gets a mask in its info after a step, but no agent gets one after reset" in str(late.findings)


def test_observations_for_which_gradients_overflow_are_a_fault_unless_they_are_normalised() -> None:
    for normalized in (False, True):
        config = LeagueConfig.from_mapping(
            league(Far).model_dump(by_alias=True) | {"training": {"normalize_observations": normalized}}
        )
        examination = examine(config, episodes=1)
        assert examination.passed == normalized
        overflows = [finding for finding in examination.findings if "training needs at most 1e+09" in finding.text]
        assert len(overflows) == (0 if normalized else 1), "one for all values"
        assert all(re.search(r"in observation: .*; first: 1\.\d+e\+12$", str(finding)) for finding in overflows)
