import random
import re
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from numpy.typing import NDArray

from league.config.league import LeagueConfig
from league.environments.conformance import episodes, time_budget
from league.environments.conformance.examination import examine
from league.environments.conformance.findings import Examination
from league.environments.conformance.openings import OpeningLength, OpeningMeasurement, recommended
from league.environments.vector.vector_env import AgentRows
from policy_league.examples.kuhn_poker_vector import KuhnPokerVector
from tests.support.environments.counting import Counting
from tests.support.environments.simultaneous import Simultaneous

pytestmark = pytest.mark.usefixtures("short_examinations")

HERE = "tests.league.environments"
SUPPORT = "tests.support.environments"


def league(entry_point: str, **kwargs: Any) -> LeagueConfig:
    policies = {"policies": {"a": ["*_0"], "b": ["*_1"]}} if entry_point.startswith("tests") else {}
    return LeagueConfig.from_mapping(
        {"league": "x", "environment": {"entry_point": entry_point, "kwargs": kwargs}, **policies}
    )


def findings(found: Examination, severity: str) -> str:
    return "\n".join(str(finding) for finding in found.findings if finding.severity == severity)


@pytest.mark.parametrize(
    "entry_point",
    [
        "pettingzoo.classic.connect_four_v3",
        "pettingzoo.classic.leduc_holdem_v4",
        "pettingzoo.classic.rps_v2",
        "mpe2.simple_spread_v3",
        "policy_league.examples.traffic:crossing",
        "policy_league.examples.two_step:parallel_env",
        "policy_league.examples.two_step:multi_agent_env",
        f"{SUPPORT}.counting:counting",
        f"{SUPPORT}.simultaneous:meeting",
        f"{SUPPORT}.simultaneous:rllib_meeting",
    ],
)
def test_valid_environments_pass(entry_point: str) -> None:
    config = league(entry_point)
    if "traffic" in entry_point:
        config = LeagueConfig.load("policy_league/configs/cars_and_lights.yaml")
    found = examine(config)
    assert found.passed, found.findings
    assert found.lengths
    assert min(found.lengths) > 0


class IgnoresSeed(Counting):
    """Its reset ignores the seed: each episode differs from the previous one."""

    played = 0

    def reset(self, seed: int | None = None, options: dict | None = None) -> None:
        IgnoresSeed.played += 1
        super().reset(IgnoresSeed.played, options)


def ignores_seed() -> IgnoresSeed:
    return IgnoresSeed()


class Forgetful(Simultaneous):
    """Its first reset has other observations than the later ones."""

    resets = 0

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        self.resets += 1
        return super().reset(min(self.resets, 2), options)


def forgetful() -> Forgetful:
    return Forgetful()


class Shuffled(Simultaneous):
    """It draws from a generator that all code shares. module: `random` or `numpy.random`."""

    def __init__(self, module: str) -> None:
        super().__init__()
        self.draw = random.random if module == "random" else np.random.random

    def _observe(self, agent: str) -> np.ndarray:
        return np.full(3, self.draw(), np.float32)


def shuffled(module: str) -> Shuffled:
    return Shuffled(module)


def test_state_that_resets_keep_is_told_from_randomness_without_a_seed() -> None:
    kept = findings(examine(league(f"{__name__}:forgetful")), "fault")
    assert "after other episodes: reset must clear all state; first: the observation in report 1, of agent_0" in kept
    for module in ("random", "numpy.random"):
        drawn = findings(examine(league(f"{__name__}:shuffled", module=module)), "fault")
        assert "in each new environment: all randomness must follow the seed of reset" in drawn
        assert f"it draws from the generator of the module {module};" in drawn


def test_steps_are_those_of_the_environment() -> None:
    """Several agents act in one step, and removed agents are no step."""
    for entry_point, kwargs, lengths, actions in (
        (f"{SUPPORT}.simultaneous:meeting", {"leaves": [3, 3]}, [3] * 3, 3),
        (f"{SUPPORT}.simultaneous:meeting", {"leaves": [2, 7]}, [7] * 3, 7),
        (f"{SUPPORT}.simultaneous:rllib_meeting", {"ends": 5}, [5] * 3, 3),
        (f"{SUPPORT}.counting:counting", {"lives": [3, 3]}, [6] * 3, 3),
        ("mpe2.simple_spread_v3", {}, [25] * 3, 25),
    ):
        found = examine(league(entry_point, **kwargs))
        assert (found.lengths, found.actions_per_episode) == (lengths, actions), entry_point


class Slow(Simultaneous):
    """Seeds alone do not vary its games."""

    seconds = 0.0
    """What its steps have taken, by a clock that only they move."""

    def step(self, actions: dict[str, int]) -> tuple[dict, ...]:
        Slow.seconds += 0.02
        return super().step(actions)

    def _observe(self, agent: str) -> np.ndarray:
        return np.array([self.time, 0, 0], np.float32)


def slow() -> Slow:
    return Slow(leaves=(1000, 1000))


def test_checks_of_a_slow_environment_are_cut_short_and_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = SimpleNamespace(monotonic=lambda: Slow.seconds, perf_counter=lambda: Slow.seconds)
    for module in (time_budget, episodes):
        monkeypatch.setattr(module, "time", clock)
    doing: list[str] = []
    found = examine(league(f"{__name__}:slow"), seconds=1.0, progress=doing.append)
    assert found.passed, found.findings
    assert re.search(
        r"the checks were cut short after 1 s, because the environment takes 0.02\d* s per step: 1 of 3 episodes were"
        r" played, the last one only to step \d+, random openings were not measured, PettingZoo's API test was not run",
        findings(found, "note"),
    )
    assert found.actions_per_episode is None
    assert found.openings is None
    assert doing


@pytest.mark.parametrize(
    ("entry_point", "least", "most"),
    [
        ("mpe2.simple_spread_v3", 0.95, 0.999),
        ("policy_league.examples.two_step:parallel_env", 1.0, 1.0),
        ("mpe2.simple_adversary_v3", -1.0, 0.0),
        ("pettingzoo.classic.connect_four_v3", -1.0, -1.0),
    ],
)
def test_returns_that_agree_are_those_of_a_team(entry_point: str, least: float, most: float) -> None:
    found = examine(LeagueConfig.from_mapping({"league": "x", "environment": {"entry_point": entry_point}}))
    assert found.agreement is not None
    assert round(found.agreement, 6) >= least
    assert round(found.agreement, 6) <= most
    assert found.is_team == ("are they one team?" in findings(found, "note")) == (least > 0)


@pytest.mark.parametrize(
    ("entry_point", "expected"),
    [
        ("mpe2.simple_adversary_v3", '`metadata["hidden_information"] = True` and `render_for(agent)`'),
        ("pettingzoo.classic.leduc_holdem_v4", "the environment declares `render_for(agent)`"),
        ("pettingzoo.classic.tictactoe_v3", ""),
        ("policy_league.examples.traffic:crossing", ""),
    ],
)
def test_how_to_declare_hidden_information_is_said_where_observations_differ(entry_point: str, expected: str) -> None:
    config = LeagueConfig.from_mapping({"league": "x", "environment": {"entry_point": entry_point}})
    if "traffic" in entry_point:
        config = LeagueConfig.load("policy_league/configs/cars_and_lights.yaml")
    found = examine(config, episodes=1)
    assert expected in found.views
    assert bool(found.views) == bool(expected)


class WrongShape(Simultaneous):
    def _observe(self, agent: str) -> np.ndarray:
        return np.zeros(4, np.float32)


def wrong_shape() -> WrongShape:
    return WrongShape()


def test_an_environment_that_ignores_the_seed_is_a_fault() -> None:
    assert "the same seed gives another episode" in findings(examine(league(f"{__name__}:ignores_seed")), "fault")


def test_an_observation_outside_the_space_is_a_fault() -> None:
    found = examine(league(f"{__name__}:wrong_shape"))
    assert "agent_0 and 1 more: observes observation with shape [4], but its space has [3]" in findings(found, "fault")


def test_rewards_that_are_not_finite_are_faults() -> None:
    found = examine(league(f"{SUPPORT}.simultaneous:meeting", bad_reward=float("nan")))
    assert "agent_0: got a reward of nan" in findings(found, "fault")


def test_an_exception_is_a_fault_with_its_message() -> None:
    found = examine(league(f"{SUPPORT}.simultaneous:meeting", crashes=[0]))
    expected = r"simultaneous.py, line \d+, step 2 of the episode with seed 0\): RuntimeError: the simulator is gone"
    assert re.search(expected, findings(found, "fault"))


class Endless(Simultaneous):
    """Its episodes do not end within 10,000 steps."""

    def __init__(self) -> None:
        super().__init__(leaves=(10**9, 10**9))


def endless() -> Endless:
    return Endless()


def test_an_endless_episode_is_a_fault_that_names_the_limit() -> None:
    config = league(f"{__name__}:endless")
    config = config.model_copy(update={"play": config.play.model_copy(update={"max_moves": 50})})
    assert "did not end within 50 steps (play.max_moves)" in findings(examine(config), "fault")
    assert "did not end within 20 steps" in findings(examine(config, steps=20), "note")


class OutOfBounds(Simultaneous):
    def observation_space(self, agent: str) -> spaces.Space:
        return spaces.Box(0, 2, (3,), np.float32)


def out_of_bounds() -> OutOfBounds:
    return OutOfBounds()


def test_a_value_out_of_bounds_is_named() -> None:
    found = findings(examine(league(f"{__name__}:out_of_bounds")), "note")
    assert re.search(
        r"agent_0 and 1 more: observations are not in .* observation\[1\] is 3, outside of \[0, 2\]", found
    )


class Unrewarding(Simultaneous):
    """All rewards are 0."""

    def step(self, actions: dict[str, int]) -> tuple[dict, ...]:
        observations, rewards, *rest = super().step(actions)
        return observations, dict.fromkeys(rewards, 0.0), *rest


class UnrewardingOfAnyLength(Unrewarding):
    """The seed decides the length of an episode."""

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        self.leaves = (2 + (seed or 0) % 3,) * 2
        return super().reset(seed, options)


def unrewarding(truncated: Sequence[int], any_length: bool = False) -> Unrewarding:
    return (UnrewardingOfAnyLength if any_length else Unrewarding)(truncated=truncated)


def test_an_environment_without_rewards_gets_a_note() -> None:
    assert "all rewards were 0" in findings(examine(league(f"{__name__}:unrewarding", truncated=[])), "note")


def test_only_truncated_episodes_get_a_note() -> None:
    found = examine(league(f"{SUPPORT}.simultaneous:meeting", truncated=[0, 1]))
    assert "all episodes were truncated, none was terminated" in findings(found, "note")


def test_only_truncated_episodes_without_rewards_are_a_fault() -> None:
    found = examine(league(f"{__name__}:unrewarding", truncated=[0, 1], any_length=True))
    assert "does not report how its games end" in findings(found, "fault")


def test_a_limit_of_steps_without_rewards_gets_a_note() -> None:
    found = examine(league(f"{__name__}:unrewarding", truncated=[0, 1]))
    assert found.passed
    assert "all rewards were 0" in findings(found, "note")


def test_an_environment_that_cannot_be_imported_is_a_fault() -> None:
    assert "cannot import 'no_such_module'" in findings(examine(league("no_such_module:env")), "fault")


def test_a_reused_observation_buffer_gets_a_note() -> None:
    assert "modified after they are returned" in findings(examine(league(f"{SUPPORT}.counting:counting")), "note")


def test_a_deterministic_start_gets_a_note() -> None:
    assert "play.opening_plies" in findings(examine(league("pettingzoo.classic.connect_four_v3")), "note")


def test_openings_are_recommended_where_seeds_repeat_one_game() -> None:
    found = examine(league("pettingzoo.classic.connect_four_v3")).openings
    assert found is not None
    assert found.different_games == 1
    assert 2 <= found.recommended <= 5
    assert [length.ended for length in found.lengths[:6]] == [0.0] * 6
    assert found.lengths[0].distinct == 7 / 200
    assert f"play.opening_plies: {found.recommended} is recommended" in str(found)


@pytest.mark.parametrize("entry_point", ["mpe2.simple_spread_v3", "pettingzoo.classic.leduc_holdem_v4"])
def test_openings_are_not_recommended_where_seeds_differ(entry_point: str) -> None:
    found = examine(league(entry_point)).openings
    assert found is not None
    assert found.recommended == 0
    assert "random openings are not needed" in str(found)


class OneRound(Simultaneous):
    """Nothing but the time is observed. rounds: steps of a game; odd: share of games that end after the first."""

    def __init__(self, rounds: int, early: bool) -> None:
        super().__init__(leaves=(rounds, rounds))
        self.rounds, self.early = rounds, early

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        self.leaves = (self.rounds,) * 2
        return super().reset(0, options)

    def step(self, actions: dict[str, int]) -> tuple[dict, ...]:
        if self.early and self.time == 0 and sum(actions.values()) > 0:
            self.leaves = (1, 1)
        return super().step(actions)

    def _observe(self, agent: str) -> np.ndarray:
        return np.array([self.time, self.seed, 0], np.float32)


def one_round(rounds: int, early: bool = False) -> OneRound:
    return OneRound(rounds, early)


def test_openings_that_lead_to_one_position_are_not_recommended() -> None:
    for rounds in (1, 2, 20):
        found = examine(league(f"{__name__}:one_round", rounds=rounds))
        assert found.openings is not None
        assert found.openings.recommended == 0
        assert "they are not recommended" in str(found.openings)
        assert "set play.opening_plies" not in findings(found, "note")


def test_openings_that_end_many_games_are_warned_of() -> None:
    openings = (OpeningLength(0.05, 0.4), OpeningLength(0.6, 0.5))
    found = OpeningMeasurement(1, 20, openings, 1)
    assert "end 40.0% of them: play.opening_plies: 1 is recommended. Openings of 1 ply end many games" in str(found)


def test_a_game_that_is_short_or_ends_early_gets_the_shortest_opening() -> None:
    lengths = [OpeningLength(0.1 * plies, 0.0 if plies <= 2 else 0.1) for plies in range(1, 9)]
    assert recommended(lengths, game=40) == 2, "longer ones end many games"
    assert recommended(lengths, game=3) == 1
    assert recommended([OpeningLength(0.02, 0.3)] * 8, game=40) == 1, "all end many games"
    assert recommended([OpeningLength(0.02, 0.0)] * 8, game=40) == 1, "longer ones add nothing"
    assert recommended([OpeningLength(0.005, 0.0)] * 8, game=40) == 0, "one position"


def test_openings_that_end_many_games_get_a_note() -> None:
    config = league("pettingzoo.classic.tictactoe_v3")
    config = config.model_copy(update={"play": config.play.model_copy(update={"opening_plies": 7})})
    assert re.search(
        r"play.opening_plies: 7 is long for this game. Random openings of 7 plies reach \d+ different positions in 200"
        r" games and end \d+.\d% of them",
        findings(examine(config), "note"),
    )


class ConstantImages(Simultaneous):
    """Its images never change."""

    def observation_space(self, agent: str) -> spaces.Space:
        return spaces.Box(0, 255, (8, 8, 3), np.uint8)

    def _observe(self, agent: str) -> np.ndarray:
        return np.zeros((8, 8, 3), np.uint8)


def constant_images() -> ConstantImages:
    return ConstantImages(leaves=(30, 30))


def test_constant_images_are_a_fault() -> None:
    assert "observes a constant image" in findings(examine(league(f"{__name__}:constant_images")), "fault")


@pytest.mark.parametrize(
    ("game", "kwargs"),
    [
        ("pistonball_v6", {"n_pistons": 2, "max_cycles": 30}),
        pytest.param("cooperative_pong_v6", {"max_cycles": 30}, marks=pytest.mark.slow),
    ],
)
def test_images_of_pettingzoo_are_rendered_without_a_render_mode(game: str, kwargs: dict[str, Any]) -> None:
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


class DictActions(Simultaneous):
    def action_space(self, agent: str) -> spaces.Space:
        return spaces.Dict(move=spaces.Discrete(2), talk=spaces.Discrete(2))


def dict_actions() -> DictActions:
    return DictActions()


def test_unsupported_action_spaces_are_a_fault() -> None:
    assert "expected Discrete, MultiDiscrete or a Box of floats" in findings(
        examine(league(f"{__name__}:dict_actions")), "fault"
    )


class Stateful(Counting):
    """Its global state grows, is not finite, or raises."""

    def __init__(self, kind: str) -> None:
        super().__init__([3, 3], [])
        self.kind, self.calls = kind, 0

    def state(self) -> Any:
        self.calls += 1
        match self.kind:
            case "grows":
                return np.zeros(self.calls)
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
        ("grows", "fault", "its global state has 2 numbers, after 1: expected a fixed size"),
        ("nan", "fault", "its global state has NaN or infinity"),
        ("raises", "note", "its global state, which only centralised learners need, cannot be read: RuntimeError: no"),
    ],
)
def test_a_global_state_is_a_vector_of_fixed_size(kind: str, severity: str, expected: str) -> None:
    found = examine(league(f"{HERE}.test_conformance:stateful", kind=kind))
    assert expected in findings(found, severity)
    assert found.passed == (severity == "note")


def test_the_size_of_the_global_state_is_reported() -> None:
    assert examine(league(f"{HERE}.test_conformance:stateful", kind="sound")).state_size == 6
    assert examine(league("pettingzoo.classic.rps_v2")).state_size is None


class WrongKuhnPoker(KuhnPokerVector):
    """Pays the loser."""

    def step(self, env_ids: NDArray[np.int64], actions: NDArray[Any]) -> Sequence[AgentRows]:
        return [replace(rows, rewards=-rows.rewards) for rows in super().step(env_ids, actions)]


class BrokenKuhnPoker(KuhnPokerVector):
    """Raises at each step."""

    def step(self, env_ids: NDArray[np.int64], actions: NDArray[Any]) -> Sequence[AgentRows]:
        raise ZeroDivisionError("no cards")


def kuhn_poker(vector: str) -> Examination:
    environment = {"entry_point": "policy_league.examples.kuhn_poker:env", "vector": vector}
    return examine(LeagueConfig.from_mapping({"league": "kuhn", "environment": environment}))


def test_a_vectorised_environment_is_compared() -> None:
    found = kuhn_poker("policy_league.examples.kuhn_poker_vector:KuhnPokerVector")
    assert found.passed, found.findings
    assert found.vectorised is not None
    assert found.vectorised.steps >= 500
    assert found.vectorised.steps_per_second > 0


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("WrongKuhnPoker", "the vectorised environment differs: .*reward"),
        ("BrokenKuhnPoker", "the vectorised environment raised an exception: ZeroDivisionError: no cards"),
    ],
)
def test_a_wrong_vectorised_environment_is_a_fault(name: str, message: str) -> None:
    found = kuhn_poker(f"{HERE}.test_conformance:{name}")
    assert found.vectorised is None
    assert re.search(message, findings(found, "fault"))
