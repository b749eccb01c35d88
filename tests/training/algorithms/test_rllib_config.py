import json
import re
from pathlib import Path
from typing import Any

import pytest
from ray.rllib.utils.metrics import ENV_RUNNER_RESULTS, EPISODE_MODULE_RETURN_MEAN, EPISODE_RETURN_MEAN, LEARNER_RESULTS

from league.config.algorithms import GROUP, IMPORTED, OwnSettings
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.errors import ConfigError
from policy_league.configs import bundled
from tests.support.leagues.training_leagues import counting, tictactoe
from training.algorithms.metrics import OFF_POLICY_METRICS, PPO_METRICS, training_metrics
from training.algorithms.rllib_config import (
    algorithm_config,
    check_opponents,
    check_policies_to_train,
    learning_policies,
    with_algorithm,
)
from training.runs.train import check

POLICIES = ("a", "b", "c")


def training_with_policies(policies: Any, **training: Any) -> Any:
    return tictactoe(policies_to_train=policies, **training).training


def test_a_list_applies_to_every_update_and_phases_are_cyclic() -> None:
    phases = [{"policies": ["a"], "iterations": 2}, {"policies": ["c", "b"], "iterations": 1}]
    for policies, expected in (
        (None, [POLICIES] * 7),
        (["c", "a"], [("a", "c")] * 7),
        (phases, [("a",), ("a",), ("b", "c")] * 2 + [("a",)]),
    ):
        settings = training_with_policies(policies)
        check_policies_to_train(settings, POLICIES)
        assert [learning_policies(settings, POLICIES, update) for update in range(7)] == expected


def test_unknown_policies_and_a_part_of_those_with_a_shared_encoder_are_refused() -> None:
    for unknown in (["a", "d"], [{"policies": ["d"], "iterations": 1}]):
        with pytest.raises(ConfigError, match="policies_to_train: unknown policy 'd'; the league has a, b, c"):
            check_policies_to_train(training_with_policies(unknown), POLICIES)
    for part in (["a"], [{"policies": ["a"], "iterations": 1}]):
        with pytest.raises(ConfigError, match="with shared_encoder, all policies must learn together"):
            check_policies_to_train(training_with_policies(part, shared_encoder=True), POLICIES)
    for together in (list(POLICIES), None):
        check_policies_to_train(training_with_policies(together, shared_encoder=True), POLICIES)


def test_opponents_are_not_drawn_by_scores_that_games_do_not_have() -> None:
    league = counting([3, 4, 5], [1], opponents={"league": {"sampling": "pfsp"}})
    with pytest.raises(ConfigError, match=r"^training\.opponents\.league\.sampling: pfsp needs scores.*3 sides"):
        check_opponents(league, interface(league))
    check_opponents(counting([3, 4, 5], [1], opponents={"league": {"sampling": "uniform"}}), interface(league))
    two = counting([3, 4], [1], opponents={"league": {"sampling": "pfsp"}})
    check_opponents(two, interface(two))


def test_fast_seeds_need_an_environment_that_has_them() -> None:
    for name in ("kuhn_poker", "leduc_holdem"):
        league = LeagueConfig.load(bundled.find(name))
        assert league.training.seeds == "fast"
        check(league, interface(league))
    league = tictactoe(algorithm="dqn", seeds="fast")
    with pytest.raises(ConfigError, match=r"training\.seeds: pettingzoo\.classic\.tictactoe_v3 has no fast seeds"):
        check(league, interface(league))


ALGORITHM = """
from league.config.off_policy import OffPolicyConfig
from league.config.ppo import PPOConfig
from training.algorithms.off_policy import OffPolicy
from training.algorithms.ppo import PPO

class Settings(PPOConfig):
    bonus: float = 1.0
    gamma: float = 0.5

class Bonus(PPO):
    settings_class = Settings

class Wrong(PPO):
    settings_class = OffPolicyConfig

class Empty(OffPolicy):
    pass

def function(): ...
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("league")
    (folder / "algorithm_of_test.py").write_text(ALGORITHM)
    return folder


def with_own_algorithm(folder: Path, name: str, **settings: Any) -> LeagueConfig:
    environment = {"entry_point": "pettingzoo.classic.tictactoe_v3"}
    training = {"algorithm": f"algorithm_of_test:{name}"} | settings
    return LeagueConfig.from_mapping(
        {"league": "own", "folder": str(folder), "environment": environment, "training": training}
    )


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("Bonu", {}, "has no 'Bonu', did you mean 'Bonus'?"),
        ("function", {}, "algorithm_of_test:function: expected a subclass of PPO or OffPolicy"),
        ("Wrong", {}, "settings_class: expected a subclass of PPOConfig, got <class 'league.config.off_policy"),
        ("Empty", {}, "module_class: expected a subclass of PolicyModule, got None"),
        ("Bonus", {"bonus": "much"}, "training: bonus: expected a number, got 'much'"),
        ("Bonus", {"bonuss": 1}, "training: bonuss: unknown key, did you mean 'bonus'?"),
    ],
)
def test_an_algorithm_without_the_required_parts_is_refused(
    folder: Path, name: str, settings: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)) as raised:
        with_algorithm(with_own_algorithm(folder, name, **settings))
    assert "\n" not in str(raised.value)


def test_the_settings_of_an_own_algorithm_are_stored_as_data_and_read_where_it_is_imported(folder: Path) -> None:
    league = with_algorithm(with_own_algorithm(folder, "Bonus", lr=0.01))
    stored = json.loads(league.model_dump_json(by_alias=True))
    assert (stored["training"]["bonus"], stored["training"]["gamma"], stored["training"]["lr"]) == (1, 0.5, 0.01)
    assert LeagueConfig.from_mapping(stored) == league
    del IMPORTED[league.training.algorithm]
    read = LeagueConfig.from_mapping(stored)
    assert type(read.training) is OwnSettings
    assert json.loads(read.with_training(steps=7).model_dump_json(by_alias=True))["training"] == (
        stored["training"] | {"steps": 7}
    )
    config = algorithm_config(read, interface(read))
    assert config.copy(copy_frozen=False).learner_class is config.learner_class


def test_an_installed_algorithm_has_a_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    metadata = tmp_path / "own_algorithm-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: own-algorithm\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(f"[{GROUP}]\nbonus = algorithm_of_test:Bonus\n")
    monkeypatch.syspath_prepend(tmp_path)
    training = {"algorithm": "bonus"}
    league = LeagueConfig.from_mapping({"league": "own", "environment": {"entry_point": "a:b"}, "training": training})
    assert league.training.algorithm == "algorithm_of_test:Bonus"


def test_an_update_without_finished_episodes_has_no_returns() -> None:
    """RLlib reports NaN for metrics without new values; a NaN loss means divergence and is kept."""
    result: dict[str, Any] = {
        ENV_RUNNER_RESULTS: {EPISODE_RETURN_MEAN: float("nan"), EPISODE_MODULE_RETURN_MEAN: {"shared": float("nan")}},
        LEARNER_RESULTS: {"shared": {"policy_loss": float("nan"), "loss": 2.0}},
    }
    metrics = training_metrics(result, interface(tictactoe()), PPO_METRICS | OFF_POLICY_METRICS)
    assert metrics.keys() == {"shared/policy_loss", "shared/loss"}
    result[ENV_RUNNER_RESULTS][EPISODE_RETURN_MEAN] = 1.5
    assert training_metrics(result, interface(tictactoe()))["return"] == 1.5
