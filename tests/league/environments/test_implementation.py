"""Which implementation steps an environment, and why."""

import re

import pytest

from league.config.environment import EnvironmentConfig
from league.environments import implementation as choices
from league.environments.copies import Copies, StockCopies, VectorCopies
from league.environments.implementation import VECTORISED, implementation, stepping
from league.environments.lockstep import Lockstep
from league.environments.stepping import BatchedEnvironment, Turn, each_agent_alone
from league.environments.vector.connect_four import ConnectFour
from league.errors import ConfigError
from tests.support.environments.vector_copies import VectorMeeting

PISTONBALL, SPREAD = "pettingzoo.butterfly.pistonball_v6", "mpe2.simple_spread_v3"


CONNECT_FOUR = "pettingzoo.classic.connect_four_v3"


COPIES = "tests.support.environments.vector_copies"


def copies_of(env: BatchedEnvironment) -> Copies:
    assert isinstance(env, Lockstep)
    return env.copies


def test_verified_environments_are_vectorised(monkeypatch: pytest.MonkeyPatch) -> None:
    for entry_point in VECTORISED:
        choice = implementation(EnvironmentConfig(entry_point=entry_point))
        assert choice.vector is not None
        assert choice.reason.startswith("It is vectorised by league.environments.vector")
    config = EnvironmentConfig.model_validate({"entry_point": SPREAD, "wrappers": ["frame_stack_v1"]})
    assert implementation(config).reason.endswith("mpe.simple_spread:SimpleSpread, with frame_stack_v1.")
    assert isinstance(copies_of(stepping(config, 2)), VectorCopies)
    monkeypatch.setattr(choices, "installed", lambda: choices.VERIFIED | {"supersuit": "9.9.9"})
    assert implementation(config).vector is None
    assert "equals supersuit" in implementation(config).reason
    monkeypatch.setattr(choices, "installed", lambda: {"pettingzoo": "9.9.9"})
    choice = implementation(EnvironmentConfig(entry_point=CONNECT_FOUR))
    assert choice.vector is None
    assert "but 9.9.9 is installed" in choice.reason


def test_other_environments_are_stepped_in_lockstep(subtests: pytest.Subtests) -> None:
    for config, reason in (
        ({"entry_point": PISTONBALL}, "has no vectorised implementation"),
        ({"entry_point": CONNECT_FOUR, "kwargs": {"render_mode": "rgb_array"}}, "arguments: .*render_mode"),
        ({"entry_point": SPREAD, "api": "aec"}, "aec is not the vectorised API"),
        (
            {"entry_point": CONNECT_FOUR, "kwargs": {"lives": 3}, "vector": f"{ConnectFour.__module__}:ConnectFour"},
            "lives",
        ),
    ):
        with subtests.test(config=config):
            environment = EnvironmentConfig.model_validate(config)
            choice = implementation(environment)
            assert choice.vector is None
            assert re.search(reason, choice.reason)
            assert "kwargs" in config or isinstance(copies_of(stepping(environment, 1)), StockCopies)


def test_users_name_their_own_vectorised_environment() -> None:
    config = EnvironmentConfig(entry_point=VectorMeeting.entry_point, vector=f"{COPIES}:VectorMeeting")
    assert implementation(config).vector is VectorMeeting
    assert isinstance(copies_of(stepping(config, 2)), VectorCopies)
    assert config.digest() == EnvironmentConfig(entry_point=config.entry_point).digest()
    for vector in ("nowhere:Env", f"{COPIES}:Nothing", f"{COPIES}:np", "no colon", ""):
        with pytest.raises(ConfigError, match=r"environment\.vector"):
            implementation(EnvironmentConfig(entry_point=CONNECT_FOUR, vector=vector))


def test_fast_seeds_start_other_episodes() -> None:
    clipped = [{"clip_reward_v0": {"lower_bound": -1, "upper_bound": 1}}]
    for wrappers in ([], clipped):
        document = {"entry_point": "pettingzoo.classic.leduc_holdem_v4", "wrappers": wrappers}
        config = EnvironmentConfig.model_validate(document)
        first, again, stock = (
            stepping(config, 50, fast_seeds=fast).start(each_agent_alone(range(50), 2)) for fast in (True, True, False)
        )
        assert observed(first) == observed(again) != observed(stock)
    for entry_point, reason in (
        (CONNECT_FOUR, "It is vectorised by league.environments.vector.connect_four:ConnectFour."),
        (PISTONBALL, "It is stepped in lockstep, because it has no vectorised implementation."),
    ):
        with pytest.raises(ConfigError) as error:
            stepping(EnvironmentConfig(entry_point=entry_point), 1, fast_seeds=True)
        assert str(error.value) == f"training.seeds: {entry_point} has no fast seeds, expected stock. {reason}"


def observed(turn: Turn) -> list[list[int]]:
    return [batch.observations["observation"].tolist() for batch in turn.batches.values()]
