"""A configuration: what is valid and what decides results. A fault is named by its key as the user wrote it, with what
to write instead.
"""

import re
from pathlib import Path
from typing import Any

import pytest

from league.config.algorithms import ALGORITHMS
from league.config.league import LeagueConfig
from league.config.ppo import PPOConfig
from league.errors import ConfigError

ENTRY = {"entry_point": "pettingzoo.classic.tictactoe_v3"}
MINIMAL = {"league": "mini", "environment": ENTRY}


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


def league(**parts: Any) -> LeagueConfig:
    return LeagueConfig.from_mapping(MINIMAL | parts, source="mini.yaml")


def training(**settings: Any) -> dict[str, Any]:
    return {"training": settings}


def dqn(**settings: Any) -> dict[str, Any]:
    return training(algorithm="dqn", **settings)


def test_each_shipped_config_is_valid_and_named_like_its_file() -> None:
    for path in Path("policy_league/configs").glob("*.yaml"):
        config = LeagueConfig.load(path)
        assert config.league == path.stem
        assert LeagueConfig.from_mapping(config.model_dump(mode="json", by_alias=True)) == config
    assert (league().policies, league().training.algorithm) == (None, "ppo"), "only league and environment are required"


ONE_OF = f"{', '.join(ALGORITHMS)}, or package.module:Class"


WHOLE_MESSAGES: list[tuple[dict[str, Any], str]] = [
    (
        training(opponents={"fixed": [{"reff": "@1"}]}),
        "training.opponents.fixed[0].reff: unknown key, did you mean 'ref'?",
    ),
    (training(opponents=[{"ref": "@1"}]), "training.opponents[0].share: missing, but required"),
    (training(checkpoint_every="soon"), "training.checkpoint_every: expected an integer or 'auto', got 'soon'"),
    (training(checkpoint_every=0), "training.checkpoint_every: input should be greater than or equal to 1, got 0"),
    (training(per_policy={"a": {"gama": 1}}), "training.per_policy.a.gama: unknown key, did you mean 'gamma'?"),
    (training(lr={"initia": 1, "final": 0}), "training.lr.initia: unknown key, did you mean 'initial'?"),
    ({"gate": {"anchors": "script:random"}}, "gate.anchors: expected a list, got 'script:random'"),
    ({"gate": 5}, "gate: expected a mapping, got 5"),
    ({"policies": 5}, "policies: expected a mapping or a string, got 5"),
    ({"play": {"action_names": 5}}, "play.action_names: expected a list or a mapping, got 5"),
    (training(lr="fast"), "training.lr: expected a number, got 'fast'"),
    (training(algorithm="dqm"), f"training.algorithm: expected one of {ONE_OF}, got 'dqm'"),
    (dqn(n_stepp=4), "training.n_stepp: unknown key, did you mean 'n_step'?"),
    (dqn(learners=2), "training.learners: expected 1, since only ppo supports several learners; got 2"),
    (dqn(batch_scale=2), "training.batch_scale: expected 1, since only ppo scales its batches; got 2"),
    (training(lag=-1), "training.lag: input should be greater than or equal to 0, got -1"),
    (training(lag=9), "training.lag: input should be less than or equal to 8, got 9"),
]


PARTS_OF_MESSAGES: list[tuple[dict[str, Any], str]] = [
    ({"leage": "x"}, "leage: unknown key, did you mean 'league'?"),
    ({"league": "Connect Four"}, "league: league 'Connect Four' must consist of"),
    ({"environment": {}}, "environment.entry_point: missing, but required"),
    ({"gate": {"alpha": 2}}, "gate.alpha: input should be less than 0.5, got 2"),
    ({"gate": {"elo0": 10, "elo1": 5}}, "gate: elo1 must be greater than elo0 (10)"),
    ({"gate": {"zzz": 1}}, "gate.zzz: unknown key, expected one of alpha, anchors, "),
    (training(steps=2**70), "training.steps: 1180591620717411303424, expected integers of at"),
    ({"environment": ENTRY | {"kwargs": {"sizes": [-(2**63) - 1]}}}, "environment.kwargs.sizes.0: "),
    (dqn(epochs=4), "training.epochs: unknown key, "),
    (dqn(exploration={"final": 2}), "training: exploration: initial and final"),
    (dqn(learning_starts=10**6), "training: learning_starts must be at most"),
    (dqn(distributional={"low": 1, "high": -1}), "training.distributional: high must be greater than low (1)"),
    (training(minibatch_size=4096, train_batch_size=64), "minibatch_size must be at most"),
    (training(magnet={"ref": "previous", "weight": 1}), "magnet.every is required for ref: previous"),
    (training(magnet={"ref": "uniform", "weight": 1, "every": 9}), "and only there"),
    (training(magnet={"ref": "script:random", "weight": 1}), "expected uniform, previous or a version"),
    (
        training(magnet={"ref": "@champion", "weight": 1}, recurrence={}),
        "@champion does not support recurrence: expected",
    ),
    (training(exploiter={"lrr": 1}), "training: exploiter.lrr: unknown key, did you mean 'lr'?"),
    (training(exploiter={"minibatch_size": 10**6}), "minibatch_size must be at most"),
    (
        training(exploiter={"minutes": 3, "algorithm": "dqn"}),
        "exploiter: algorithm, minutes cannot be set for exploiters",
    ),
    (training(per_policy={"hidden": {"zzz": 1}}), "per_policy.hidden.zzz: unknown key, expected one of clip, "),
    ({"policies": {}}, "policies: expected at least one entry"),
    ({"policies": {"A": ["*"]}}, "must consist of a-z"),
    ({"play": {"action_names": []}}, "at least one name"),
    ({"play": {"action_names": ["up", "up"]}}, "'up' is the name of several actions"),
    ({"play": {"action_names": ["up", " "]}}, "1 to 40 characters"),
    ({"play": {"action_names": ["x" * 41]}}, "1 to 40 characters"),
    ({"play": {"action_names": [True, "no"]}}, "play.action_names"),
    ({"play": {"action_names": {"shared": ["a", "a"]}}}, "'a' is the name of several actions"),
    ({"environment": ENTRY | {"wrappers": [{"a": 1, "b": 2}]}}, "environment.wrappers[0]"),
]


def test_a_fault_has_source_key_and_expectation(subtests: pytest.Subtests) -> None:
    for change, message in (*WHOLE_MESSAGES, *PARTS_OF_MESSAGES):
        with subtests.test(change=change):
            with pytest.raises(ConfigError, match=re.escape(message)) as error:
                league(**change)
            text = str(error.value)
            assert text.startswith("mini.yaml: ")
            assert "\n" not in text
            assert (change, message) in PARTS_OF_MESSAGES or text == f"mini.yaml: {message}"


def test_the_known_keys_are_listed_once() -> None:
    with pytest.raises(ConfigError) as caught:
        league(gate={"zzz": 1, "qqq": 2}, play={"xxx": 3})
    lists, bare = [], []
    for fault in str(caught.value).removeprefix("mini.yaml: ").split("; "):
        (lists if ", expected one of " in fault else bare).append(fault.partition(":")[0])
    assert (lists, bare) == (["play.xxx", "gate.zzz"], ["gate.qqq"])


def test_a_file_without_a_mapping_is_rejected_with_its_name(tmp_path: Path) -> None:
    path = tmp_path / "broken.yaml"
    for text in ("", "- 1\n", "a: [", "\x00", "just text"):
        path.write_text(text)
        with pytest.raises(ConfigError, match=re.escape(str(path))):
            LeagueConfig.load(path)
    with pytest.raises(ConfigError, match=r"nowhere\.yaml: No such file"):
        LeagueConfig.load(tmp_path / "nowhere.yaml")


def test_the_game_is_what_decides_results() -> None:
    for change, is_other_game, is_other_environment in (
        ({"play": {"opening_plies": 2}}, True, False),
        ({"play": {"max_moves": 100}}, True, False),
        ({"environment": ENTRY | {"kwargs": {"screen_height": 500}}}, True, True),
        ({"environment": ENTRY | {"revision": "2"}}, True, False),
        ({"environment": ENTRY | {"vector": "my_games.fast:Fast"}}, False, False),
        ({"play": {"num_envs": 3, "game_seconds": 5.0, "action_names": ["stay", "left"]}}, False, False),
        (training(lr=1e-5), False, False),
    ):
        before, after = league(), league(**change)
        assert (before.game_digest() != after.game_digest()) == is_other_game
        assert (before.environment.digest() != after.environment.digest()) == is_other_environment


def test_names_of_actions_are_those_of_all_policies_or_of_one() -> None:
    assert league(play={"action_names": ["a", "b"]}).play.names_for("any") == ("a", "b")
    of_one = league(play={"action_names": {"one": ["a"]}}).play
    assert (of_one.names_for("one"), of_one.names_for("other"), league().play.names_for("one")) == (("a",), (), ())


def test_wrappers_can_have_arguments() -> None:
    environment = ENTRY | {"wrappers": ["flatten_v0", {"frame_stack_v1": {"stack_size": 3}}]}
    wrappers = [(wrapper.name, wrapper.kwargs) for wrapper in league(environment=environment).environment.wrappers]
    assert wrappers == [("flatten_v0", {}), ("frame_stack_v1", {"stack_size": 3})]
