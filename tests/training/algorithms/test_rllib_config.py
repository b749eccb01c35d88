from typing import Any

import pytest

from league.config.league import LeagueConfig
from league.environments.building import interface
from league.errors import ConfigError
from policy_league.configs import bundled
from tests.support.leagues.training_leagues import counting, tictactoe
from training.algorithms.rllib_config import check_opponents, check_policies_to_train, learning_policies, num_envs
from training.runs.train import check

POLICIES = ("a", "b", "c")


def training_with_policies(policies: Any, **training: Any) -> Any:
    return tictactoe(policies_to_train=policies, **training).training


@pytest.mark.parametrize(("policies", "expected"), [(None, POLICIES), (["c", "a"], ("a", "c"))])
def test_a_list_applies_to_every_update(policies: Any, expected: tuple[str, ...]) -> None:
    assert [learning_policies(training_with_policies(policies), POLICIES, i) for i in range(3)] == [expected] * 3


def test_phases_are_cyclic() -> None:
    settings = training_with_policies([{"policies": ["a"], "iterations": 2}, {"policies": ["c", "b"], "iterations": 1}])
    check_policies_to_train(settings, POLICIES)
    found = [learning_policies(settings, POLICIES, i) for i in range(7)]
    assert found == [("a",), ("a",), ("b", "c")] * 2 + [("a",)]


@pytest.mark.parametrize("policies", [["a", "d"], [{"policies": ["d"], "iterations": 1}]])
def test_an_unknown_policy_is_reported(policies: Any) -> None:
    with pytest.raises(ConfigError, match="policies_to_train: unknown policy 'd'; the league has a, b, c"):
        check_policies_to_train(training_with_policies(policies), POLICIES)


@pytest.mark.parametrize("policies", [["a"], [{"policies": ["a"], "iterations": 1}]])
def test_policies_with_a_shared_encoder_must_learn_together(policies: Any) -> None:
    with pytest.raises(ConfigError, match="with shared_encoder, all policies must learn together"):
        check_policies_to_train(training_with_policies(policies, shared_encoder=True), POLICIES)
    check_policies_to_train(training_with_policies(list(POLICIES), shared_encoder=True), POLICIES)
    check_policies_to_train(training_with_policies(None, shared_encoder=True), POLICIES)


@pytest.mark.parametrize(
    ("training", "expected"),
    [
        ({"train_batch_size": 4096}, 128),
        ({"train_batch_size": 4096, "runners": 2}, 64),
        ({"train_batch_size": 512}, 32),
        ({"train_batch_size": 65536}, 512),
        ({"train_batch_size": 4096, "num_envs": 7}, 7),
        ({"algorithm": "dqn"}, 32),
    ],
    ids=["batch", "runners", "small batch", "large batch", "number", "replay buffer"],
)
def test_each_agent_gets_enough_steps_of_each_vectorised_environment(training: dict[str, Any], expected: int) -> None:
    assert num_envs(tictactoe(**{"num_envs": "auto"} | training), agents=2) == expected


def test_a_stock_environment_has_the_same_number_for_every_batch() -> None:
    assert num_envs(counting([4, 6], [1], num_envs="auto", train_batch_size=65536), agents=2) == 32


def test_opponents_are_not_drawn_by_scores_that_games_do_not_have() -> None:
    league = counting([3, 4, 5], [1], opponents={"league": {"sampling": "pfsp"}})
    with pytest.raises(ConfigError, match=r"^training\.opponents\.league\.sampling: pfsp needs scores.*3 sides"):
        check_opponents(league, interface(league))
    check_opponents(counting([3, 4, 5], [1], opponents={"league": {"sampling": "uniform"}}), interface(league))
    two = counting([3, 4], [1], opponents={"league": {"sampling": "pfsp"}})
    check_opponents(two, interface(two))


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_fast_seeds_need_an_environment_that_has_them(algorithm: str) -> None:
    league = tictactoe(algorithm=algorithm, seeds="fast")
    with pytest.raises(ConfigError, match=r"training\.seeds: pettingzoo\.classic\.tictactoe_v3 has no fast seeds"):
        check(league, interface(league))


@pytest.mark.parametrize("name", ["kuhn_poker", "leduc_holdem"])
def test_bundled_configurations_use_the_fast_seeds_of_their_environments(name: str) -> None:
    league = LeagueConfig.load(bundled.find(name))
    assert league.training.seeds == "fast"
    check(league, interface(league))
