"""Leagues of games that run in simulators, and simulators in threads that play PettingZoo's environments for them."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from league.config.league import LeagueConfig
from league.environments.building import interface
from league.environments.implementation import stock_stepping
from league.environments.stepping import BatchedEnvironment
from league.errors import LeagueError
from league.registry.gateways import ForSimulators
from league.registry.registry import Registry
from league.registry.storage.rows import Gateway, Purpose
from league.settings import Storage
from policy_league_client.simulator import PettingZooGame, SimulatedGame, simulate
from tests.support.waiting import until

NAME, VERSION = "game", "1.2"
LEAGUE = "external"


def external(stock: LeagueConfig, **parts: Any) -> LeagueConfig:
    """The league of the same game, which runs in simulators instead of Python."""
    game = interface(stock)
    agents = {agent: spaces.model_dump(mode="json") for agent, spaces in game.agents.items()}
    section = {"simulator": NAME, "version": VERSION, "agents": agents, "simultaneous": game.simultaneous}
    section |= {"hidden_information": game.hidden_information and not game.simultaneous, "deterministic": True}
    document = stock.model_dump(mode="json", by_alias=True, exclude={"league", "environment", "folder"})
    return LeagueConfig.from_mapping(document | {"league": LEAGUE, "environment": {"external": section}} | parts)


def stepping(registry: Registry, num_envs: int = 8, purpose: Purpose = "evaluation") -> BatchedEnvironment:
    """Environments of the league."""
    config = registry.leagues.get(LEAGUE).config
    return stock_stepping(config.environment, num_envs, simulators=ForSimulators(registry.storage, LEAGUE, purpose))


def registry(home: Path, config: LeagueConfig) -> Registry:
    opened = Registry.open(Storage.at(home))
    opened.leagues.register(config, interface(config))
    return opened


def gateway(registry: Registry, league: str = LEAGUE) -> Gateway:
    """The gateway of a league, once it is open."""
    until(lambda: registry.gateways.open(league))
    return registry.gateways.open(league)[0]


def pettingzoo(make: Callable[[], Any]) -> Callable[[], SimulatedGame]:
    return lambda: PettingZooGame(make())


@contextmanager
def simulating(
    registry: Registry,
    make_game: Callable[[], SimulatedGame],
    *,
    episodes: int = 4,
    binary: bool = True,
    count: int = 1,
) -> Iterator[None]:
    """Simulators in threads, which end with the block, after the message for which they wait."""

    stop = threading.Event()

    def run() -> None:
        with suppress(LeagueError, TimeoutError):
            door = gateway(registry)
            simulate(
                door.url,
                LEAGUE,
                make_game,
                name=NAME,
                version=VERSION,
                key=door.token,
                episodes=episodes,
                binary=binary,
                stop=stop,
            )

    threads = [threading.Thread(target=run, daemon=True) for _ in range(count)]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        stop.set()
