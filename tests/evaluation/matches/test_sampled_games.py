"""Games with sampled actions: seeded, recorded, equal in every batch, and distributed as the policy says."""

from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binomtest, kstest

from evaluation.matches.game_loop import play_matches
from evaluation.matches.game_state import ActionNumbers, action_keys
from evaluation.playback.replay import replay
from evaluation.schedules.builders import round_robin
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.environments.implementation import stepping
from league.environments.lockstep import stock_stepping
from league.policies.draws import probabilities
from league.policies.onnx import OnnxPolicy
from league.policies.scripted import script
from league.random.seeds import derive
from league.results.records import Match, Schedule
from league.spaces import Discrete
from tests.support.environments.kinds import KINDS
from tests.support.policies.graphs import masked_mlp

CONFIG = LeagueConfig.from_mapping(
    {
        "league": "kuhn",
        "environment": {
            "entry_point": "policy_league.examples.kuhn_poker:env",
            "vector": "policy_league.examples.kuhn_poker_vector:KuhnPokerVector",
        },
        "policies": {"shared": ["*"]},
    }
)
INTERFACE = interface(CONFIG)
SPACES = INTERFACE.of_policy("shared")
CONTESTANTS = ["kuhn@1", "kuhn@2", "script:random"]


def graphs(has_distribution: bool = True) -> dict[str, OnnxPolicy]:
    made = [masked_mlp((11,), 2, seed=seed) for seed in range(2)]
    return {f"kuhn@{i + 1}": OnnxPolicy(graph, has_distribution=has_distribution) for i, graph in enumerate(made)}


def play(schedule: Schedule, num_envs: int, stock: bool = False, has_distribution: bool = True) -> list[Match]:
    policies = {**graphs(has_distribution), "script:random": script("random", SPACES.observation, SPACES.action)}
    roster = {ref: dict.fromkeys(INTERFACE.agents, ("shared", policy)) for ref, policy in policies.items()}
    environment = (stock_stepping if stock else stepping)(CONFIG.environment, num_envs)
    return play_matches(schedule, range(schedule.length), environment, INTERFACE, roster)


def schedule_of(blocks: int, seed: int = 0) -> Schedule:
    return round_robin(CONFIG, INTERFACE, CONTESTANTS, blocks, seed)


def test_numbers_differ_between_games_agents_and_steps_only() -> None:
    keys = action_keys(np.array([5, 5, 2**62]), np.array([0, 1, 0]), agents=2)
    assert (keys[0] >> np.uint64(1)).tolist() == [derive(5, "action", 0, agent) for agent in (0, 1)]
    numbers = ActionNumbers(np.repeat(keys.ravel(), 100), np.tile(np.arange(100), 6))
    drawn = numbers.draw((3,))
    assert drawn.shape == (600, 3)
    assert len(np.unique(drawn)) == 1800
    assert kstest(drawn.ravel(), "uniform").pvalue > 0.01
    np.testing.assert_array_equal(numbers.row(7).draw((3,)), drawn[7:8])


def test_games_are_equal_in_any_number_of_environments() -> None:
    schedule = schedule_of(blocks=4)
    expected = play(schedule, 1, stock=True)
    assert len(expected) == 12
    for num_envs in (1, 32, 512):
        assert play(schedule, num_envs) == expected


def test_recorded_games_are_replayed_exactly() -> None:
    for match in play(schedule_of(blocks=2), 8):
        for game in range(2):
            steps = list(replay(stock_stepping(CONFIG.environment, 1), CONFIG, INTERFACE, match, game))
            assert steps[-1].is_over


def test_sampled_games_of_one_policy_are_independent_within_a_block() -> None:
    """With greedy actions, both games of a block are the same game if the contestants are."""
    alike = OnnxPolicy(masked_mlp((11,), 2))
    roster = {ref: dict.fromkeys(INTERFACE.agents, ("shared", alike)) for ref in CONTESTANTS[:2]}
    sampled = round_robin(CONFIG, INTERFACE, CONTESTANTS[:2], 30)
    different = {}
    for schedule in (sampled, replace(sampled, actions="greedy")):
        matches = play_matches(schedule, range(30), stepping(CONFIG.environment, 64), INTERFACE, roster)
        different[schedule.actions] = sum(match.games[0].actions != match.games[1].actions for match in matches)
    assert different["greedy"] == 0
    assert different["sampled"] > 10


def test_first_actions_have_the_distribution_of_the_policy() -> None:
    policy, environment = graphs()["kuhn@1"], stock_stepping(CONFIG.environment, 1)
    found: defaultdict[bytes, list[int]] = defaultdict(list)
    for match in play(round_robin(CONFIG, INTERFACE, CONTESTANTS[:2], 400), 512):
        game = replay(environment, CONFIG, INTERFACE, match, 0)
        next(game)
        (move,) = next(game).moves
        found[move.observation["observation"].tobytes()].append(move.action)
    assert len(found) == 3, "one observation for each card"
    for observation, actions in found.items():
        seen = {
            "observation": np.frombuffer(observation, np.int8)[np.newaxis],
            "action_mask": np.ones((1, 2), np.int8),
        }
        logits = policy.distribution(seen).dist_inputs
        assert logits is not None
        ((_, bet),) = probabilities(logits, Discrete(n=2))
        assert 0.2 < bet < 0.8
        assert binomtest(sum(actions), len(actions), bet).pvalue > 0.01


def test_policies_without_a_distribution_stay_greedy() -> None:
    schedule = replace(schedule_of(blocks=4), id="equal")
    assert play(schedule, 32, has_distribution=False) == play(replace(schedule, actions="greedy"), 32)


def test_games_depend_on_the_seed() -> None:
    first, second = ([match.games for match in play(schedule_of(4, seed), 32)] for seed in (0, 1))
    assert first != second


@pytest.mark.parametrize("name", ["roles", "memory"])
def test_sampled_actions_of_all_kinds_are_played_and_replayed(name: str) -> None:
    kind = KINDS[name]
    schedule = replace(kind.schedule(["kind@1", "kind@2"], blocks=2), actions="sampled")
    matches = kind.play(schedule, num_envs=1)
    assert matches == kind.play(schedule, num_envs=3)
    assert not any(game.forfeits for match in matches for game in match.games)
    environment = stock_stepping(kind.config.environment, 1)
    assert list(replay(environment, kind.config, kind.interface, matches[0], 1))[-1].is_over
    greedy = kind.play(replace(schedule, actions="greedy"), num_envs=3)
    assert [match.games for match in greedy] != [match.games for match in matches]
