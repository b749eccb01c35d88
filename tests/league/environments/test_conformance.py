from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from league.config import LeagueConfig
from league.environments.conformance import Examination, examine
from tests.league.environments.counting import Counting
from tests.league.environments.simultaneous import Meeting

HERE = "tests.league.environments"


def league(entry_point: str, **kwargs: Any) -> LeagueConfig:
    policies = {"policies": {"a": ["*_0"], "b": ["*_1"]}} if entry_point.startswith("tests") else {}
    return LeagueConfig.from_mapping(
        {"league": "x", "environment": {"entry_point": entry_point, "kwargs": kwargs}, **policies}
    )


def told(found: Examination, severity: str) -> str:
    return "\n".join(str(finding) for finding in found.findings if finding.severity == severity)


@pytest.mark.parametrize(
    "entry_point",
    [
        "pettingzoo.classic.connect_four_v3",
        "pettingzoo.classic.leduc_holdem_v4",
        "pettingzoo.classic.rps_v2",
        "mpe2.simple_spread_v3",
        "examples.traffic:crossing",
        "examples.two_step:parallel_env",
        "examples.two_step:multi_agent_env",
        f"{HERE}.counting:counting",
        f"{HERE}.simultaneous:meeting",
        f"{HERE}.simultaneous:rllib_meeting",
    ],
)
def test_sound_environments_pass(entry_point: str) -> None:
    config = league(entry_point)
    if "traffic" in entry_point:
        config = LeagueConfig.load("configs/cars_and_lights.yaml")
    found = examine(config)
    assert found.passed, found.findings
    assert found.lengths
    assert min(found.lengths) > 0


class Forgetful(Counting):
    """Its reset forgets the seed: each episode differs from the one before."""

    played = 0

    def reset(self, seed: int | None = None, options: dict | None = None) -> None:
        Forgetful.played += 1
        super().reset(Forgetful.played, options)


def forgetful() -> Forgetful:
    return Forgetful()


class Misshapen(Meeting):
    def _observe(self, agent: str) -> np.ndarray:
        return np.zeros(4, np.float32)


def misshapen() -> Misshapen:
    return Misshapen()


def test_what_does_not_follow_the_seed_is_a_fault() -> None:
    assert "the same seed brings another episode" in told(examine(league(f"{__name__}:forgetful")), "fault")


def test_a_shape_that_is_not_the_spaces_is_a_fault() -> None:
    found = examine(league(f"{__name__}:misshapen"))
    assert "agent_0 and 1 more: observes observation of shape [4], its space says [3]" in told(found, "fault")


def test_rewards_that_are_no_numbers_are_faults() -> None:
    found = examine(league(f"{HERE}.simultaneous:meeting", bad_reward=float("nan")))
    assert "agent_0: got a reward of nan" in told(found, "fault")


def test_an_environment_that_raises_is_a_fault_with_its_words() -> None:
    found = examine(league(f"{HERE}.simultaneous:meeting", crashes=[0]))
    assert "RuntimeError: the simulator is gone" in told(found, "fault")


def test_what_cannot_be_made_is_a_fault_by_name() -> None:
    assert "cannot import 'no_such_module'" in told(examine(league("no_such_module:env")), "fault")


def test_observations_that_are_written_over_are_worth_a_note() -> None:
    assert "written over later" in told(examine(league(f"{HERE}.counting:counting")), "note")


def test_a_deterministic_beginning_is_worth_a_note() -> None:
    assert "play.opening_plies" in told(examine(league("pettingzoo.classic.connect_four_v3")), "note")


class Blind(Meeting):
    """Its screen is never drawn."""

    def observation_space(self, agent: str) -> spaces.Space:
        return spaces.Box(0, 255, (8, 8, 3), np.uint8)

    def _observe(self, agent: str) -> np.ndarray:
        return np.zeros((8, 8, 3), np.uint8)


def blind() -> Blind:
    return Blind(leaves=(30, 30))


def test_pictures_that_never_change_are_a_fault() -> None:
    assert "observes the same picture all the time" in told(examine(league(f"{__name__}:blind")), "fault")


@pytest.mark.parametrize(
    ("game", "kwargs"),
    [("pistonball_v6", {"n_pistons": 2, "max_cycles": 30}), ("cooperative_pong_v6", {"max_cycles": 30})],
)
def test_pettingzoos_pictures_are_drawn_without_being_asked(game: str, kwargs: dict[str, Any]) -> None:
    found = examine(
        LeagueConfig.from_mapping(
            {
                "league": "x",
                "environment": {"entry_point": f"pettingzoo.butterfly.{game}", "kwargs": kwargs},
                "policies": {"left": ["*_0"], "rest": ["*"]},
            }
        ),
        episodes=1,
    )
    assert found.passed, found.findings


class Twofold(Meeting):
    def action_space(self, agent: str) -> spaces.Space:
        return spaces.Dict(move=spaces.Discrete(2), talk=spaces.Discrete(2))


def twofold() -> Twofold:
    return Twofold()


def test_actions_that_no_policy_can_give_are_a_fault() -> None:
    assert "expected Discrete, MultiDiscrete or Box" in told(examine(league(f"{__name__}:twofold")), "fault")


class Stateful(Counting):
    """Its global state grows, is not finite, or cannot be had."""

    def __init__(self, kind: str) -> None:
        super().__init__([3, 3], [])
        self.kind, self.asked = kind, 0

    def state(self) -> Any:
        self.asked += 1
        match self.kind:
            case "grows":
                return np.zeros(self.asked)
            case "nan":
                return np.full((2, 2), np.nan)
            case "raises":
                raise RuntimeError("no camera")
        return np.zeros((2, 3), np.int8)


def stateful(kind: str) -> Stateful:
    return Stateful(kind)


@pytest.mark.parametrize(
    ("kind", "severity", "expected"),
    [
        ("grows", "fault", "its global state has 2 numbers, after 1: expected always as many"),
        ("nan", "fault", "its global state has NaN or infinity"),
        ("raises", "note", "its global state cannot be read, which only centralised learners need: RuntimeError: no"),
    ],
)
def test_a_global_state_is_one_row_of_numbers(kind: str, severity: str, expected: str) -> None:
    found = examine(league(f"{HERE}.test_conformance:stateful", kind=kind))
    assert expected in told(found, severity)
    assert found.passed == (severity == "note")


def test_the_size_of_a_global_state_is_told() -> None:
    assert examine(league(f"{HERE}.test_conformance:stateful", kind="sound")).state_size == 6
    assert examine(league("pettingzoo.classic.rps_v2")).state_size is None
