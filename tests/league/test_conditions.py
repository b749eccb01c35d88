"""How versions select actions, by the configuration and the environment."""

from enum import Enum
from types import SimpleNamespace
from typing import Any

import pytest

from league.conditions import action_selection, describe_selection, hides_information
from league.config.league import LeagueConfig
from league.environments.building import build, interface
from policy_league.examples.kuhn_poker import KuhnPoker


def config(entry_point: str, **parts: Any) -> LeagueConfig:
    return LeagueConfig.from_mapping({"league": "one", "environment": {"entry_point": entry_point}} | parts)


ADVERSARY = "mpe2.simple_adversary_v3"
STEERED = {"entry_point": ADVERSARY, "kwargs": {"continuous_actions": True}}


def open_game() -> Any:
    """Simultaneous moves in an environment that declares that it hides nothing."""
    env = build(config(ADVERSARY).environment)
    env.unwrapped.metadata = {**env.unwrapped.metadata, "hidden_information": False}
    return env


LEDUC, CHESS = "pettingzoo.classic.leduc_holdem_v4", "pettingzoo.classic.tictactoe_v3"


@pytest.mark.parametrize(
    ("league", "expected", "reason"),
    [
        (config(LEDUC), "sampled", "hides information from opponents"),
        (config("pettingzoo.classic.rps_v2"), "sampled", "hides information from opponents"),
        (config("policy_league.examples.kuhn_poker:env"), "sampled", "hides information from opponents"),
        (config(ADVERSARY), "sampled", "opponents act at once"),
        (config(ADVERSARY, play={"actions": "greedy"}), "greedy", "as play.actions says"),
        (config(ADVERSARY, sides={"team": ["*"]}), "greedy", "there is only one side"),
        (config(ADVERSARY, environment=STEERED), "greedy", "is not known to hide information"),
        (config(f"{__name__}:open_game"), "greedy", "is not known to hide information"),
        (config(CHESS), "greedy", "is not known to hide information"),
        (config(CHESS, play={"actions": "sampled"}), "sampled", "as play.actions says"),
        (config(LEDUC, play={"actions": "greedy"}), "greedy", "as play.actions says"),
        (config(LEDUC, sides={"team": ["*"]}), "greedy", "there is only one side"),
    ],
)
def test_actions_are_sampled_if_opponents_lack_information(league: LeagueConfig, expected: str, reason: str) -> None:
    described = interface(league)
    assert action_selection(league, described) == expected
    assert describe_selection(league, described).startswith(f"Versions play with {expected} actions")
    assert reason in describe_selection(league, described)


def test_value_based_versions_are_described_as_greedy() -> None:
    league = config(LEDUC, training={"algorithm": "dqn"})
    assert "those of dqn have no action distribution" in describe_selection(league, interface(league))


def test_the_declaration_of_an_environment_precedes_its_name() -> None:
    env = KuhnPoker()
    assert hides_information(env)
    env.metadata = {"name": "leduc_holdem_v4", "hidden_information": False}
    assert not hides_information(env)
    assert hides_information(build(config(LEDUC).environment))


def test_games_of_openspiel_are_recognised_by_their_types() -> None:
    information = Enum("Information", ["PERFECT_INFORMATION", "IMPERFECT_INFORMATION", "ONE_SHOT"])
    dynamics = Enum("Dynamics", ["SEQUENTIAL", "SIMULTANEOUS"])

    def adapter(known: Any, moves: Any) -> Any:
        return SimpleNamespace(metadata={}, game_type=SimpleNamespace(information=known, dynamics=moves))

    assert hides_information(adapter(information.IMPERFECT_INFORMATION, dynamics.SEQUENTIAL))
    assert hides_information(adapter(information.PERFECT_INFORMATION, dynamics.SIMULTANEOUS))
    assert not hides_information(adapter(information.PERFECT_INFORMATION, dynamics.SEQUENTIAL))
