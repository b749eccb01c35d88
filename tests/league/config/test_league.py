import re
from pathlib import Path

import pytest

from league.config.algorithms import ALGORITHMS
from league.config.league import LeagueConfig
from league.config.ppo import PPOConfig
from league.errors import ConfigError

CONFIGS = sorted(Path("policy_league/configs").glob("*.yaml"))
MINIMAL = {"league": "mini", "environment": {"entry_point": "pettingzoo.classic.tictactoe_v3"}}


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_each_shipped_config_is_valid_and_named_like_its_file(path: Path) -> None:
    assert LeagueConfig.load(path).league == path.stem


def test_only_league_and_environment_are_required() -> None:
    config = LeagueConfig.from_mapping(MINIMAL)
    assert config.policies is None
    assert config.training.algorithm == "ppo"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"leage": "x"}, "leage: unknown key, did you mean 'league'?"),
        ({"league": "Connect Four"}, "league: league 'Connect Four' must consist of"),
        ({"environment": {}}, "environment.entry_point: missing, but required"),
        ({"gate": {"alpha": 2}}, "gate.alpha: input should be less than 0.5, got 2"),
        ({"gate": {"elo0": 10, "elo1": 5}}, "gate: elo1 must be greater than elo0 (10)"),
        (
            {"training": {"algorithm": "dqm"}},
            f"training.algorithm: expected one of {', '.join(ALGORITHMS)}, or package.module:Class, got 'dqm'",
        ),
        (
            {"training": {"steps": 2**70}},
            "training.steps: 1180591620717411303424, expected integers of at",
        ),
        (
            {"environment": {"entry_point": "a:b", "kwargs": {"sizes": [-(2**63) - 1]}}},
            "environment.kwargs.sizes.0: ",
        ),
        ({"training": {"lr": "fast"}}, "training.lr: expected a number, got 'fast'"),
        ({"training": {"lrr": 1}}, "training.lrr: unknown key, did you mean 'lr'?"),
        ({"training": {"algorithm": "dqn", "epochs": 4}}, "training.epochs: unknown key, "),
        (
            {"training": {"algorithm": "dqn", "learners": 2}},
            "training.learners: expected 1, since only ppo supports several learners; got 2",
        ),
        (
            {"training": {"algorithm": "dqn", "batch_scale": 2}},
            "training.batch_scale: expected 1, since only ppo scales its batches; got 2",
        ),
        ({"training": {"algorithm": "dqn", "n_stepp": 4}}, "training.n_stepp: unknown key, did you mean 'n_step'?"),
        (
            {"training": {"algorithm": "dqn", "exploration": {"finall": 0}}},
            "training.exploration.finall: unknown key, did you mean 'final'?",
        ),
        ({"training": {"algorithm": "dqn", "exploration": {"final": 2}}}, "training: exploration: initial and final"),
        ({"training": {"algorithm": "dqn", "learning_starts": 10**6}}, "training: learning_starts must be at most"),
        (
            {"training": {"algorithm": "dqn", "distributional": {"low": 1, "high": -1}}},
            "training.distributional: high must be greater than low (1)",
        ),
        ({"training": {"lag": -1}}, "training.lag: input should be greater than or equal to 0, got -1"),
        ({"training": {"lag": 9}}, "training.lag: input should be less than or equal to 8, got 9"),
        ({"training": {"minibatch_size": 4096, "train_batch_size": 64}}, "minibatch_size must be at most"),
        ({"training": {"magnet": {"ref": "previous", "weight": 1}}}, "magnet.every is required for ref: previous"),
        ({"training": {"magnet": {"ref": "uniform", "weight": 1, "every": 9}}}, "and only there"),
        (
            {"training": {"magnet": {"ref": "script:random", "weight": 1}}},
            "expected uniform, previous or a version",
        ),
        (
            {"training": {"magnet": {"ref": "@champion", "weight": 1}, "recurrence": {}}},
            "magnet.ref @champion does not support recurrence: expected uniform",
        ),
        ({"training": {"exploiter": {"lrr": 1}}}, "training: exploiter.lrr: unknown key, did you mean 'lr'?"),
        ({"training": {"exploiter": {"lr": "fast"}}}, "training: exploiter.lr: expected a number, got 'fast'"),
        ({"training": {"exploiter": {"minibatch_size": 10**6}}}, "minibatch_size must be at most"),
        (
            {"training": {"exploiter": {"minutes": 3, "algorithm": "dqn"}}},
            "training.exploiter: algorithm, minutes cannot be set for exploiters only",
        ),
        ({"training": 3}, "training: "),
        ({"policies": {}}, "policies: expected at least one entry"),
        ({"policies": {"A": ["*"]}}, "must consist of a-z"),
        ({"play": {"opening_plies": -1}}, "play.opening_plies: "),
        ({"environment": {"entry_point": "x", "wrappers": [{"a": 1, "b": 2}]}}, "environment.wrappers[0]"),
    ],
)
def test_a_fault_has_source_key_and_expectation(change: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)) as error:
        LeagueConfig.from_mapping(MINIMAL | change, source="mini.yaml")
    assert str(error.value).startswith("mini.yaml: ")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("text", ["", "- 1\n", "a: [", "\x00", "just text"])
def test_a_file_without_a_mapping_is_rejected_with_its_name(tmp_path: Path, text: str) -> None:
    path = tmp_path / "broken.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=re.escape(str(path))):
        LeagueConfig.load(path)


def test_a_missing_file_is_reported(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nowhere\.yaml: No such file"):
        LeagueConfig.load(tmp_path / "nowhere.yaml")


def test_a_config_survives_json() -> None:
    config = LeagueConfig.load("policy_league/configs/connect_four.yaml")
    assert LeagueConfig.from_mapping(config.model_dump(mode="json", by_alias=True)) == config


def test_the_environment_digest_depends_on_the_environment_only() -> None:
    config = LeagueConfig.from_mapping(MINIMAL)
    other_training = LeagueConfig.from_mapping(MINIMAL | {"training": {"lr": 1e-5}})
    other = MINIMAL["environment"] | {"kwargs": {"screen_height": 500}}
    other_environment = LeagueConfig.from_mapping(MINIMAL | {"environment": other})
    assert config.environment.digest() == other_training.environment.digest()
    assert config.environment.digest() != other_environment.environment.digest()


@pytest.mark.parametrize(
    ("change", "is_other_game"),
    [
        ({"play": {"opening_plies": 2}}, True),
        ({"play": {"max_moves": 100}}, True),
        ({"environment": MINIMAL["environment"] | {"kwargs": {"screen_height": 500}}}, True),
        ({"environment": MINIMAL["environment"] | {"revision": "2"}}, True),
        ({"environment": MINIMAL["environment"] | {"vector": "my_games.fast:Fast"}}, False),
        ({"play": {"num_envs": 3, "game_seconds": 5.0}}, False),
        ({"training": {"lr": 1e-5}}, False),
    ],
)
def test_the_game_is_what_decides_results(change: dict, is_other_game: bool) -> None:
    before, after = (LeagueConfig.from_mapping(document) for document in (MINIMAL, MINIMAL | change))
    assert (before.game_digest() != after.game_digest()) == is_other_game


def test_the_revision_and_the_rules_of_play_do_not_exclude_versions() -> None:
    plain = LeagueConfig.from_mapping(MINIMAL)
    environment = MINIMAL["environment"] | {"revision": "2"}
    revised = LeagueConfig.from_mapping(MINIMAL | {"environment": environment, "play": {"opening_plies": 2}})
    assert plain.environment.digest() == revised.environment.digest()


def test_wrappers_can_have_arguments() -> None:
    environment = MINIMAL["environment"] | {"wrappers": ["flatten_v0", {"frame_stack_v1": {"stack_size": 3}}]}
    wrappers = LeagueConfig.from_mapping(MINIMAL | {"environment": environment}).environment.wrappers
    assert [(wrapper.name, wrapper.kwargs) for wrapper in wrappers] == [
        ("flatten_v0", {}),
        ("frame_stack_v1", {"stack_size": 3}),
    ]


def test_replaced_training_settings_are_validated() -> None:
    config = LeagueConfig.from_mapping(MINIMAL)
    assert config.with_training(minutes=3).training.minutes == 3
    with pytest.raises(ConfigError, match=r"training\.minutes"):
        config.with_training(minutes=-1)


def test_exploiters_have_settings_of_their_own() -> None:
    training = {"lr": 0.001, "gamma": 0.5, "exploiter": {"lr": {"initial": 0.1, "final": 0}, "magnet": None}}
    training["magnet"] = {"ref": "uniform", "weight": 1}
    config = LeagueConfig.from_mapping(MINIMAL | {"training": training})
    settings = config.against("mini@3").training
    assert isinstance(settings, PPOConfig)
    assert (settings.lr.initial, settings.magnet, settings.gamma) == (0.1, None, 0.5)
    assert [opponent.ref for opponent in settings.opponents.fixed] == ["mini@3"]
    assert config.against("mini@3") == config.against("mini@3").against("mini@3")
