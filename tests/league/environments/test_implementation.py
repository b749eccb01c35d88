"""Which implementation steps an environment, and why."""

from typing import Any

import pytest

from league.config.environment import EnvironmentConfig
from league.environments import implementation as choice
from league.environments.implementation import VECTORISED, implementation, stepping
from league.environments.lockstep import Lockstep
from league.environments.stepping import Turn, each_agent_alone
from league.environments.vector.connect_four import ConnectFour
from league.environments.vector_stepping import VectorStepping
from league.errors import ConfigError
from tests.support.environments.vector_copies import VectorMeeting

CONNECT_FOUR = "pettingzoo.classic.connect_four_v3"
COPIES = "tests.support.environments.vector_copies"


@pytest.mark.parametrize("entry_point", VECTORISED)
def test_verified_environments_are_vectorised(entry_point: str) -> None:
    found = implementation(EnvironmentConfig(entry_point=entry_point))
    assert found.vector is not None
    assert found.reason.startswith("It is vectorised by league.environments.vector")


@pytest.mark.parametrize(
    ("config", "reason"),
    [
        ({"entry_point": "pettingzoo.butterfly.pistonball_v6"}, "has no vectorised implementation"),
        ({"entry_point": "mpe2.simple_spread_v3", "wrappers": ["black_death_v3"]}, "wrapper black_death_v3"),
        ({"entry_point": CONNECT_FOUR, "kwargs": {"render_mode": "rgb_array"}}, "arguments: .*render_mode"),
        ({"entry_point": "mpe2.simple_spread_v3", "api": "aec"}, "aec is not the vectorised API"),
    ],
)
def test_other_environments_are_stepped_in_lockstep(config: dict[str, Any], reason: str) -> None:
    environment = EnvironmentConfig.model_validate(config)
    found = implementation(environment)
    assert found.vector is None
    with pytest.raises(AssertionError, match=reason):
        raise AssertionError(found.reason)
    assert isinstance(stepping(environment, 1), Lockstep)


def test_another_version_of_the_stock_environment_is_stepped_in_lockstep(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(choice, "installed", lambda: {"pettingzoo": "9.9.9"})
    found = implementation(EnvironmentConfig(entry_point=CONNECT_FOUR))
    assert found.vector is None
    assert "but 9.9.9 is installed" in found.reason


def test_wrappers_are_vectorised_with_the_verified_version_of_supersuit(monkeypatch: pytest.MonkeyPatch) -> None:
    config = EnvironmentConfig.model_validate({"entry_point": "mpe2.simple_spread_v3", "wrappers": ["frame_stack_v1"]})
    found = implementation(config)
    assert found.reason.endswith("mpe.simple_spread:SimpleSpread, with frame_stack_v1.")
    assert isinstance(stepping(config, 2), VectorStepping)
    monkeypatch.setattr(choice, "installed", lambda: choice.VERIFIED | {"supersuit": "9.9.9"})
    assert implementation(config).vector is None
    assert "equals supersuit" in implementation(config).reason


def test_users_name_their_own_vectorised_environment() -> None:
    config = EnvironmentConfig(entry_point=VectorMeeting.entry_point, vector=f"{COPIES}:VectorMeeting")
    assert implementation(config).vector is VectorMeeting
    assert isinstance(stepping(config, 2), VectorStepping)
    assert config.digest() == EnvironmentConfig(entry_point=config.entry_point).digest()


@pytest.mark.parametrize("vector", ["nowhere:Env", f"{COPIES}:Nothing", f"{COPIES}:np", "no colon", ""])
def test_an_invalid_vectorised_environment_is_rejected(vector: str) -> None:
    with pytest.raises(ConfigError, match=r"environment\.vector"):
        implementation(EnvironmentConfig(entry_point=CONNECT_FOUR, vector=vector))


def test_arguments_that_a_vectorised_environment_does_not_have_are_rejected() -> None:
    config = EnvironmentConfig(
        entry_point=CONNECT_FOUR, kwargs={"lives": 3}, vector=f"{ConnectFour.__module__}:ConnectFour"
    )
    assert implementation(config).vector is None


CLIPPED = [{"clip_reward_v0": {"lower_bound": -1, "upper_bound": 1}}]


@pytest.mark.parametrize("wrappers", [[], CLIPPED], ids=["plain", "wrapped"])
def test_fast_seeds_start_other_episodes(wrappers: list[Any]) -> None:
    config = EnvironmentConfig.model_validate(
        {"entry_point": "pettingzoo.classic.leduc_holdem_v4", "wrappers": wrappers}
    )
    first, again, stock = (
        stepping(config, 50, fast_seeds=fast).start(each_agent_alone(range(50), 2)) for fast in (True, True, False)
    )
    assert observed(first) == observed(again) != observed(stock)


def observed(turn: Turn) -> list[list[int]]:
    return [batch.observations["observation"].tolist() for batch in turn.batches.values()]


@pytest.mark.parametrize(
    ("entry_point", "reason"),
    [
        (CONNECT_FOUR, "It is vectorised by league.environments.vector.connect_four:ConnectFour."),
        (
            "pettingzoo.butterfly.pistonball_v6",
            "It is stepped in lockstep, because it has no vectorised implementation.",
        ),
    ],
)
def test_an_environment_without_fast_seeds_is_named(entry_point: str, reason: str) -> None:
    with pytest.raises(ConfigError) as error:
        stepping(EnvironmentConfig(entry_point=entry_point), 1, fast_seeds=True)
    assert str(error.value) == f"training.seeds: {entry_point} has no fast seeds, expected stock. {reason}"
