"""A fault of a configuration names the key as the user wrote it, and what to write instead."""

from typing import Any

import pytest

from league.config.league import LeagueConfig
from league.errors import ConfigError

MINIMAL = {"league": "mini", "environment": {"entry_point": "pettingzoo.classic.tictactoe_v3"}}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"training": {"opponents": {"fixed": [{"reff": "@1"}]}}},
            "training.opponents.fixed[0].reff: unknown key, did you mean 'ref'?;"
            " training.opponents.fixed[0].share: missing, but required",
        ),
        (
            {"gate": {"anchors": [{"ref": "@1", "margn": 2}]}},
            "gate.anchors[0].margn: unknown key, did you mean 'margin'?",
        ),
        (
            {"training": {"policies_to_train": [{"polices": ["a"], "iterations": 5}]}},
            "training.policies_to_train[0].polices: unknown key, did you mean 'policies'?",
        ),
        (
            {"training": {"per_policy": {"a": {"gama": 1}}}},
            "training.per_policy.a.gama: unknown key, did you mean 'gamma'?",
        ),
        ({"training": {"lr": {"initia": 1, "final": 0}}}, "training.lr.initia: unknown key, did you mean 'initial'?"),
        (
            {"training": {"convolutions": [{"filter": 3}]}},
            "training.convolutions[0].filter: unknown key, did you mean 'filters'?",
        ),
        ({"gate": {"anchors": "script:random"}}, "gate.anchors: expected a list, got 'script:random'"),
        ({"gate": 5}, "gate: expected a mapping, got 5"),
        ({"league": 5}, "league: expected a string, got 5"),
        ({"policies": 5}, "policies: expected a mapping or a string, got 5"),
        ({"play": {"action_names": 5}}, "play.action_names: expected a list or a mapping, got 5"),
        ({"training": {"hidden": ["a"]}}, "training.hidden[0]: expected an integer, got 'a'"),
        ({"training": {"lr": "fast"}}, "training.lr: expected a number, got 'fast'"),
    ],
)
def test_the_whole_message(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as error:
        LeagueConfig.from_mapping(MINIMAL | change, source="mini.yaml")
    assert str(error.value) == f"mini.yaml: {message}"


def test_an_unknown_key_without_a_similar_one_lists_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"gate\.zzz: unknown key, expected one of alpha, anchors, "):
        LeagueConfig.from_mapping(MINIMAL | {"gate": {"zzz": 1}})


def test_the_known_keys_are_listed_once() -> None:
    with pytest.raises(ConfigError) as caught:
        LeagueConfig.from_mapping(MINIMAL | {"gate": {"zzz": 1, "qqq": 2}, "play": {"xxx": 3}})
    lists, bare = [], []
    for fault in str(caught.value).removeprefix("configuration: ").split("; "):
        (lists if ", expected one of " in fault else bare).append(fault.partition(":")[0])
    assert (lists, bare) == (["play.xxx", "gate.zzz"], ["gate.qqq"])


def test_a_key_of_a_mapping_is_checked_by_the_type_of_its_values() -> None:
    with pytest.raises(ConfigError, match=r"training\.per_policy\.hidden\.zzz: unknown key, expected one of clip, "):
        LeagueConfig.from_mapping(MINIMAL | {"training": {"per_policy": {"hidden": {"zzz": 1}}}})
