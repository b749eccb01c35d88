"""Episodes of simulators equal those of the same environments in Python."""

import importlib
import threading
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import pytest

from evaluation.matches.game_loop import play_matches
from evaluation.schedules.builders import round_robin
from league.config.league import LeagueConfig
from league.environments.lockstep import stock_stepping
from league.environments.stepping import BatchedEnvironment
from league.errors import LeagueError
from league.registry.gateways import Gateway
from league.registry.registry import Registry
from policy_league_client.simulator import PettingZooGame, Report, SimulatedGame, simulate
from tests.conformance.stepping import assert_abandoning_conforms, assert_stepping_conforms
from tests.support import simulators
from tests.support.environments.lockstep import CONFIG, CONTESTANTS, INTERFACE, build_roster
from tests.support.simulators import LEAGUE, NAME, VERSION, external, gateway, pettingzoo, simulating, stepping

ENVIRONMENTS: dict[str, tuple[str, dict[str, Any]]] = {
    "pettingzoo.classic.tictactoe_v3": ("env", {}),
    "pettingzoo.classic.texas_holdem_no_limit_v6": ("env", {"num_players": 3}),
    "pettingzoo.classic.rps_v2": ("parallel_env", {"max_cycles": 6}),
    "mpe2.simple_world_comm_v3": ("parallel_env", {"continuous_actions": True}),
}


@pytest.fixture(params=ENVIRONMENTS)
def case(request: pytest.FixtureRequest) -> tuple[LeagueConfig, Callable[[], Any]]:
    """A league of a stock environment, and a function that creates the environment."""
    function, kwargs = ENVIRONMENTS[request.param]
    config = LeagueConfig.from_mapping(
        {"league": "stock", "environment": {"entry_point": request.param, "kwargs": kwargs}}
    )
    make = getattr(importlib.import_module(request.param), function)
    return config, lambda: make(**kwargs)


@pytest.fixture
def opened(case: tuple[LeagueConfig, Callable[[], Any]], tmp_path: Path) -> Registry:
    return simulators.registry(tmp_path, external(case[0]))


@pytest.mark.parametrize(
    ("check", "binary", "count"),
    [(assert_stepping_conforms, True, 1), (assert_stepping_conforms, False, 3), (assert_abandoning_conforms, True, 2)],
)
def test_episodes_equal_the_plain_loop(
    case: tuple[LeagueConfig, Callable[[], Any]], opened: Registry, check: Callable[..., None], binary: bool, count: int
) -> None:
    stock = case[1]
    steppings: list[BatchedEnvironment] = []

    def make(num_envs: int) -> BatchedEnvironment:
        steppings.append(stepping(opened, num_envs))
        return steppings[-1]

    with simulating(opened, pettingzoo(stock), episodes=2, binary=binary, count=count):
        check(make, stock, seeds=[11, 12, 13, 14, 15, 16], num_envs=3)
    steppings[0].close()


def test_matches_are_those_of_the_game_in_python(tmp_path: Path) -> None:
    config = external(CONFIG)
    opened = simulators.registry(tmp_path, config)
    schedule = round_robin(CONFIG, INTERFACE, CONTESTANTS, 4)
    positions = range(schedule.length)
    expected = play_matches(schedule, positions, stock_stepping(CONFIG.environment, 8), INTERFACE, build_roster())
    with closing(stepping(opened)) as environment, simulating(opened, pettingzoo(TICTACTOE), episodes=3, count=2):
        for _ in range(2):  # the gateway stays open between two tournaments
            assert play_matches(schedule, positions, environment, INTERFACE, build_roster()) == expected


TICTACTOE = importlib.import_module(CONFIG.environment.entry_point).env


class Crash(Exception):
    pass


class Mortal(PettingZooGame):
    """A game whose program ends after some steps."""

    def __init__(self, env: Any, steps: int) -> None:
        super().__init__(env)
        self._left = steps

    def step(self, actions: Mapping[str, Any]) -> list[Report]:
        self._left -= 1
        if self._left < 0:
            raise Crash
        return super().step(actions)


@pytest.mark.parametrize("deaths", [3, pytest.param(200, marks=pytest.mark.slow)])
def test_games_of_simulators_that_die_are_repeated(tmp_path: Path, deaths: int) -> None:
    config = external(CONFIG)
    opened = simulators.registry(tmp_path, config)
    schedule = round_robin(CONFIG, INTERFACE, CONTESTANTS, 4 if deaths < 10 else 80)
    positions = range(schedule.length)
    expected = play_matches(schedule, positions, stock_stepping(CONFIG.environment, 8), INTERFACE, build_roster())
    steps = iter([*range(2, 2 + 3 * deaths, 3)][:deaths] if deaths < 10 else [5 + i % 20 for i in range(deaths)])
    died = []

    def run() -> None:
        """One program after the other: each ends in the middle of its games."""
        with suppress(LeagueError, TimeoutError):
            door = gateway(opened)
            for mortal in steps:
                try:
                    play(door, lambda: Mortal(TICTACTOE(), mortal))  # noqa: B023  it is called within the iteration
                except Crash:
                    died.append(mortal)
            play(door, pettingzoo(TICTACTOE))

    def play(door: Gateway, make_game: Callable[[], SimulatedGame]) -> None:
        simulate(door.url, LEAGUE, make_game, name=NAME, version=VERSION, key=door.token, episodes=3)

    with closing(stepping(opened)) as environment:
        threading.Thread(target=run, daemon=True).start()
        assert play_matches(schedule, positions, environment, INTERFACE, build_roster()) == expected
    assert len(died) == deaths
