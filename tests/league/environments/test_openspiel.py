import numpy as np
import pytest
from pettingzoo.test import api_test, seed_test

from league.config.league import LeagueConfig
from league.environments.building import build, interface
from league.environments.conformance.examination import examine
from league.environments.openspiel import env
from league.errors import ConfigError

GAMES = "backgammon breakthrough connect_four goofspiel hex kuhn_poker leduc_poker liars_dice matrix_rps othello pig"


pytest.importorskip("pyspiel")


def league(game: str, **kwargs: object) -> LeagueConfig:
    environment = {"entry_point": "openspiel", "kwargs": {"game": game, **kwargs}}
    return LeagueConfig.from_mapping({"league": game, "environment": environment})


def test_the_returns_are_those_of_the_game() -> None:
    game = env("tic_tac_toe")
    game.reset(seed=0)
    for action in (0, 3, 1, 4, 2):
        assert game.observe(game.agent_selection)["action_mask"][action]
        game.step(action)
    assert game.rewards == {"player_0": 1.0, "player_1": -1.0}
    assert all(game.terminations.values())


def test_parameters_and_information_states() -> None:
    described = interface(league("kuhn_poker", players=3, information_state=True))
    assert len(described.agents) == 3
    assert described.hidden_information
    current, information = (env("kuhn_poker", information_state=value) for value in (False, True))
    shapes = [game.observation_space("player_0")["observation"].shape for game in (current, information)]
    assert shapes == [(7,), (11,)]
    assert env("connect_four").observation_space("player_0")["observation"].shape == (6, 7, 3), "planes are an image"


def test_simultaneous_moves_are_hidden_until_both_have_moved() -> None:
    views = []
    for first in (0, 1):
        game = env("matrix_rps")
        game.reset(seed=0)
        game.step(first)
        views.append(game.observe("player_1")["observation"])
    assert np.array_equal(*views)
    assert interface(league("matrix_rps")).hidden_information


@pytest.mark.parametrize("game", [*GAMES.split(), "tic_tac_toe"])
def test_games_pass_pettingzoos_tests(game: str) -> None:
    api_test(env(game), num_cycles=50)
    seed_test(lambda: env(game), num_cycles=20)
    if game in ("kuhn_poker", "matrix_rps", "tic_tac_toe"):
        examination = examine(league(game))
        assert examination.passed, examination.findings


def test_unsupported_games_are_rejected() -> None:
    for game, kwargs, message in (
        ("no_such_game", {}, "OpenSpiel cannot load game 'no_such_game'"),
        ("kuhn_poker", {"colour": 1}, "OpenSpiel cannot load game 'kuhn_poker'"),
        ("mfg_crowd_modelling", {}, "mean-field game"),
    ):
        with pytest.raises(ConfigError, match=message):
            build(league(game, **kwargs).environment)
