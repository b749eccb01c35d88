"""Which keys of a Dict observation are the mask, and which are observed, for all APIs."""

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from numpy.typing import NDArray

from league.config.environment import EnvironmentConfig
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.environments.conformance.examination import examine
from league.environments.lockstep import stock_stepping
from league.environments.stepping import each_agent_alone
from league.errors import EnvironmentMismatch, IllegalAction
from league.spaces import inputs
from tests.support.environments import masked
from tests.support.environments.masked import ACTIONS, AGENTS, APIS, BOX, ParallelMasked, RLlibMasked


def league(api: str, space: str, **kwargs: Any) -> LeagueConfig:
    environment = {"entry_point": f"{masked.__name__}:{api}", "kwargs": {"space": space, **kwargs}}
    return LeagueConfig.from_mapping({"league": "masked", "environment": environment})


def illegal(space: str) -> NDArray:
    return np.array([1]) if space not in ACTIONS else np.array([[0, 1]])


@pytest.mark.parametrize("api", APIS)
@pytest.mark.parametrize(
    ("space", "names"),
    [
        ("obs", ["observation", "action_mask"]),
        ("nested", ["observation.a", "observation.b", "action_mask"]),
        ("secret", ["observation.observation", "observation.secret", "action_mask"]),
        ("multi", ["observation", "action_mask"]),
    ],
)
def test_the_mask_counts_whatever_the_other_keys_are_called_and_all_are_observed(
    api: str, space: str, names: list[str]
) -> None:
    config = league(api, space)
    found = examine(config, episodes=1)
    assert found.passed, found.findings
    assert list(inputs(interface(config).agents["ann"].observation)) == names
    stepping = stock_stepping(config.environment, 1)
    turn = stepping.start(each_agent_alone([0], 2))
    assert list(turn.batches[0].observations) == names
    with pytest.raises(IllegalAction, match="action_mask is"):
        stepping.step({group: illegal(space) for group in turn.batches})


@pytest.mark.parametrize(
    ("space", "reason"),
    [
        ("joint", r"agent ann: action_mask has the shape \[2, 3\], expected \[5\]: one number for each choice of"),
        ("short", r"agent ann: action_mask has the shape \[2\], expected \[3\]: one number for each action"),
        ("parts", r"agent ann: action_mask is a Dict, expected \[3\]"),
        ("only", "agent ann: observations contain only action_mask: expected at least one more key"),
    ],
)
def test_a_mask_that_does_not_fit_is_refused_with_both_sizes(space: str, reason: str) -> None:
    with pytest.raises(EnvironmentMismatch, match=reason):
        interface(league("ParallelMasked", space))


def test_with_actions_that_cannot_be_masked_the_key_is_observed_like_any_other() -> None:
    config = league("ParallelMasked", "obs", continuous=True)
    assert examine(config, episodes=1).passed
    observation = interface(config).agents["ann"].observation
    assert sorted(inputs(observation)) == ["observation.action_mask", "observation.obs"]
    assert type(observation).model_validate_json(observation.model_dump_json()) == observation


class InfoMasks:
    """Masks in infos only, after reset or only after a step. The observation has two other keys."""

    def __init__(self, late: bool = False) -> None:
        super().__init__(space="obs")  # type: ignore[call-arg]
        self.late = late
        self.observed = spaces.Dict({"obs": BOX, "secret": BOX})
        self.observation_spaces = dict.fromkeys(AGENTS, self.observed)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return super().reset(seed=seed)[0], {} if self.late else self.masks()  # type: ignore[misc]

    def step(self, actions: dict[str, Any]) -> Any:
        return *super().step(actions)[:-1], self.masks()  # type: ignore[misc]

    def move(self, action: Any) -> None:
        if self.late:
            self.turn += 1
        else:
            super().move(action)  # type: ignore[misc]

    def masks(self) -> dict[str, Any]:
        return {agent: {"action_mask": np.array([1, 0, 1])} for agent in AGENTS}


class ParallelInfoMasks(InfoMasks, ParallelMasked): ...


class RLlibInfoMasks(InfoMasks, RLlibMasked): ...


@pytest.mark.parametrize("environment", ["ParallelInfoMasks", "RLlibInfoMasks"])
def test_masks_in_infos_join_observations_with_several_keys(environment: str) -> None:
    config = EnvironmentConfig(entry_point=f"{__name__}:{environment}")
    found = examine(LeagueConfig(league="x", environment=config), episodes=1)
    assert found.passed, found.findings
    stepping = stock_stepping(config, 1)
    turn = stepping.start(each_agent_alone([0], 2))
    assert list(turn.batches[0].observations) == ["observation.obs", "observation.secret", "action_mask"]
    with pytest.raises(IllegalAction, match=r"action_mask is \[1, 0, 1\]"):
        stepping.step({group: np.array([1]) for group in turn.batches})


@pytest.mark.parametrize("environment", ["ParallelInfoMasks", "RLlibInfoMasks"])
def test_masks_that_appear_only_after_a_step_are_a_fault(environment: str) -> None:
    config = EnvironmentConfig(entry_point=f"{__name__}:{environment}", kwargs={"late": True})
    examination = examine(LeagueConfig(league="x", environment=config), episodes=1)
    assert "gets a mask in its info after a step, but no agent gets one after reset" in str(examination.findings)


class Far(ParallelMasked):
    """Observes a time in milliseconds since 1970."""

    def __init__(self) -> None:
        super().__init__("obs")

    def value(self, space: Any = None, key: str = "") -> Any:
        value = super().value(space, key)
        return value if space else value | {"obs": np.array([1.7e12, self.rng.uniform()], np.float32)}


@pytest.mark.parametrize("normalized", [False, True])
def test_observations_for_which_gradients_overflow_are_a_fault_unless_they_are_normalised(normalized: bool) -> None:
    environment = {"entry_point": f"{__name__}:Far"}
    training = {"normalize_observations": normalized}
    config = LeagueConfig.from_mapping({"league": "x", "environment": environment, "training": training})
    found = examine(config, episodes=1)
    assert found.passed == normalized
    assert ("1.7e+12 in observation: training needs values of at most 1e+09" in str(found.findings)) != normalized
