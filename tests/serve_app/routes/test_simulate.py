"""Simulators reach whatever needs episodes of their league through the server, with an API key."""

import importlib
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus

from evaluation.matches.game_loop import play_matches
from evaluation.schedules.builders import round_robin
from league.environments.implementation import stock_stepping
from league.errors import Forbidden, InvalidInput, LeagueError, Unauthenticated, UnknownLeague
from league.registry.registry import Registry
from policy_league_client.endpoint import Endpoint
from policy_league_client.simulator import PettingZooGame, Play, Report, SimulatorConnection, simulate
from serve_app.routes import simulate as route
from tests.support import simulators
from tests.support.environments.lockstep import CONFIG, CONTESTANTS, INTERFACE, build_roster
from tests.support.servers.streaming import Listening, listening
from tests.support.simulators import LEAGUE, NAME, VERSION, external, gateway, stepping
from tests.support.waiting import until

FIRST = Report("player_1", {"observation": np.zeros((3, 3, 2), np.int8), "action_mask": np.ones(9, np.int8)})


@pytest.fixture
def opened(tmp_path: Path) -> Registry:
    return simulators.registry(tmp_path, external(CONFIG))


@pytest.fixture
def tokens(opened: Registry) -> dict[str, str]:
    """Name of a key → its token. The server starts when they exist."""
    scopes = {"simulator": ["simulate"], "second": ["simulate"], "reader": ["read", "act"]}
    return {name: opened.keys.create(name, of_key)[1] for name, of_key in scopes.items()}


@pytest.fixture
def server(opened: Registry, tokens: dict[str, str]) -> Iterator[Listening]:
    with listening(opened.storage) as listener:
        yield listener


def connection(server: Listening, key: str, league: str = LEAGUE) -> SimulatorConnection:
    return SimulatorConnection(Endpoint(server.url, key, None, 60.0), league, NAME, VERSION, 2)


def run(server: Listening, key: str, **options: Any) -> None:
    """Run a simulator of the game."""
    make = importlib.import_module(CONFIG.environment.entry_point).env
    simulate(server.url, LEAGUE, lambda: PettingZooGame(make()), name=NAME, version=VERSION, key=key, **options)


@pytest.mark.parametrize("binary", [True, False])
def test_matches_through_the_server_are_those_of_the_game_in_python(
    opened: Registry, server: Listening, tokens: dict[str, str], binary: bool
) -> None:
    schedule = round_robin(CONFIG, INTERFACE, CONTESTANTS, 2)
    positions = range(schedule.length)
    expected = play_matches(schedule, positions, stock_stepping(CONFIG.environment, 8), INTERFACE, build_roster())
    options = {"episodes": 3, "binary": binary, "limit": 2 * schedule.length}
    simulator = threading.Thread(target=run, args=(server, tokens["simulator"]), kwargs=options, daemon=True)
    simulator.start()  # it waits until something needs episodes
    with closing(stepping(opened)) as environment:
        assert play_matches(schedule, positions, environment, INTERFACE, build_roster()) == expected
        until(lambda: not simulator.is_alive())


def test_a_simulator_needs_a_key_with_its_scope(server: Listening, tokens: dict[str, str]) -> None:
    refusals: tuple[tuple[str, str, int, type[LeagueError] | None], ...] = (
        ("", LEAGUE, 401, Unauthenticated),
        ("plk_x", LEAGUE, 401, Unauthenticated),
        (tokens["reader"], LEAGUE, 403, Forbidden),
        (tokens["simulator"], "nowhere", 404, UnknownLeague),
        (tokens["simulator"], LEAGUE, 503, None),  # nothing needs episodes yet
    )
    for token, league, status, error in refusals:
        with pytest.raises(InvalidStatus) as refused:
            connection(server, token, league)
        assert refused.value.response.status_code == status
        if error is not None:
            with pytest.raises(error):
                simulate(server.url, league, lambda: PettingZooGame(None), name=NAME, version=VERSION, key=token)


def test_an_invalid_report_is_named_and_a_revoked_key_ends_the_connection(
    opened: Registry, server: Listening, tokens: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(route, "CHECK_INTERVAL", 0.1)
    with closing(stepping(opened, 2)) as environment:
        schedule = round_robin(CONFIG, INTERFACE, CONTESTANTS[:2], 1)
        player = threading.Thread(
            target=lambda: play_matches(schedule, [0], environment, INTERFACE, build_roster()), daemon=True
        )
        player.start()
        gateway(opened)
        hostile = connection(server, tokens["simulator"])
        play = hostile.receive()
        assert isinstance(play, Play)
        hostile.report([(play.episodes[0], FIRST), (play.episodes[0], FIRST)])
        with pytest.raises(InvalidInput, match="reports twice"):
            hostile.receive()
        revoked = connection(server, tokens["simulator"])
        assert isinstance(revoked.receive(), Play)
        opened.keys.revoke("simulator")
        with pytest.raises(ConnectionClosed) as closed:
            revoked.receive()
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 1008
        run(server, tokens["second"], episodes=2, limit=2)
        until(lambda: not player.is_alive())
