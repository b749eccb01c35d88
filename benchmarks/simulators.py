"""How fast do games train that run in simulators, compared with the same games in Python?

Parts: stock (PPO on PettingZoo's connect four, 2×256 units, 64 games: in the runner, and in a program of its own in one
connection), vectorised (likewise on the vectorised environment), protocol (processor time per action of the
gateway with 64 rows in a message, whose simulator repeats one observation), slow (actions per second of a simulator
beside one that takes a second for each action, divided by those without it). All processes share the machine's cores.
"""

import multiprocessing
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pettingzoo.classic import connect_four_v3

from benchmarks.harness import Parts, Quick, Target, chosen, in_rounds
from benchmarks.training.learned import local_ray
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.environments.implementation import stock_stepping
from league.environments.stepping import Starts
from league.environments.vector.connect_four import ConnectFour
from league.environments.vector.vector_env import AgentRows
from league.registry.gateways import ForSimulators
from league.registry.registry import Registry
from league.registry.storage.rows import Gateway
from league.settings import Storage
from policy_league_client.endpoint import Endpoint
from policy_league_client.simulator import (
    OVER,
    TERMINATED,
    TRUNCATED,
    ActionRows,
    PettingZooGame,
    Play,
    ReportBlock,
    SimulatorConnection,
    simulate,
)
from tests.support.simulators import LEAGUE, NAME, VERSION, external, gateway, registry
from training.runs.trial import build_algorithm

GAMES = 64
AT_LEAST, MICROSECONDS, SLOWED = 0.9, 15.0, 0.95
SPAWN = multiprocessing.get_context("spawn")


def play_stock(door: Gateway, games: int) -> None:
    """Play PettingZoo's environment."""
    # Without the wrappers that check the order of calls, as training in Python steps it.
    make = lambda: PettingZooGame(connect_four_v3.raw_env())  # noqa: E731
    simulate(door.url, LEAGUE, make, name=NAME, version=VERSION, key=door.token, episodes=games)


def play_vectorised(door: Gateway, games: int) -> None:
    """Play the vectorised environment, in arrays."""
    connection, env = connect(door, games), ConnectFour(games)
    slots: dict[int, int] = {}
    episodes, free = np.zeros(games, np.int64), list(range(games))

    def report(blocks: Any) -> None:
        rows: AgentRows
        for rows in blocks:
            over = ~np.isin(rows.envs, rows.envs[~rows.has_ended])
            flags = rows.terminations * TERMINATED + rows.truncations * TRUNCATED
            last = np.append(rows.envs[1:] != rows.envs[:-1], True)
            flags = flags + (over & last) * OVER
            columns = [rows.observations["observation"], rows.observations["action_mask"]]
            connection.report_rows(ReportBlock(0, episodes[rows.envs], rows.agents, rows.rewards, flags, columns))
            for slot in rows.envs[over & last].tolist():
                del slots[int(episodes[slot])]
                free.append(slot)

    while True:
        event = connection.receive()
        if isinstance(event, Play):
            places = np.array(sorted(free.pop() for _ in event.episodes))
            episodes[places] = event.episodes
            slots |= dict(zip(event.episodes, places.tolist(), strict=True))
            report(env.reset(places, np.array(event.seeds)))
        elif isinstance(event, ActionRows):
            envs = np.array([slots[episode] for episode in event.episodes.tolist()])
            order = np.argsort(envs)
            report(env.step(envs[order], event.actions[order]))


def repeat_one_observation(door: Gateway, games: int) -> None:
    """Answer each action by the same observation; episodes never end."""
    connection = connect(door, games)
    board, mask = np.zeros((games, 6, 7, 2), np.int8), np.ones((games, 7), np.int8)
    zeros = np.zeros(games)
    while True:
        event = connection.receive()
        if isinstance(event, Play):
            count = len(event.episodes)
            columns = [board[:count], mask[:count]]
            connection.report_rows(
                ReportBlock(0, np.array(event.episodes), zeros[:count], zeros[:count], zeros[:count], columns)
            )
        elif isinstance(event, ActionRows):
            count = len(event.episodes)
            columns = [board[:count], mask[:count]]
            connection.report_rows(ReportBlock(0, event.episodes, event.agents, zeros[:count], zeros[:count], columns))


def take_a_second(door: Gateway, games: int) -> None:
    """Play as `repeat_one_observation`, at one action per second."""

    class Slow(PettingZooGame):
        def step(self, actions: Mapping[str, Any]) -> Any:
            time.sleep(1)
            return super().step(actions)

    make = lambda: Slow(connect_four_v3.env())  # noqa: E731
    simulate(door.url, LEAGUE, make, name=NAME, version=VERSION, key=door.token, episodes=games)


def connect(door: Gateway, games: int) -> SimulatorConnection:
    """Connect with arrays."""
    return SimulatorConnection(Endpoint(door.url, door.token, None, 10.0), LEAGUE, NAME, VERSION, games)


@contextmanager
def playing(registry: Registry, play: Callable[[Gateway, int], None], games: int) -> Iterator[None]:
    """A simulator in a process of its own, which connects when a gateway is open."""
    process = SPAWN.Process(target=_play, args=(registry.storage, play, games), daemon=True)
    process.start()
    try:
        yield
    finally:
        process.terminate()
        process.join()


def _play(storage: Storage, play: Callable[[Gateway, int], None], games: int) -> None:
    with closing(Registry.open(storage, create=False)) as opened, suppress(OSError):
        play(gateway(opened), games)


def league(*, is_vectorised: bool) -> LeagueConfig:
    """Connect four in Python, as it is trained."""
    environment = {"entry_point": "pettingzoo.classic.connect_four_v3"}
    if not is_vectorised:
        environment = {"entry_point": f"{__name__}:stock"}
    training = {"hidden": [256, 256], "runners": 1, "num_envs": GAMES, "threads": 1, "train_batch_size": 4096}
    return LeagueConfig.from_mapping({"league": "in_python", "environment": environment, "training": training})


def stock() -> Any:
    """PettingZoo's connect four, under a name without a vectorised environment."""
    return connect_four_v3.env()


@contextmanager
def league_of_simulators(config: LeagueConfig) -> Iterator[Registry]:
    """The registry of a league with the game of another one, which runs in simulators."""
    with tempfile.TemporaryDirectory() as home, closing(registry(Path(home), external(config))) as opened:
        yield opened


def trained(config: LeagueConfig, storage: Storage, seconds: float) -> float:
    """Actions per second of PPO."""
    algorithm = build_algorithm(config, interface(config), storage=storage)
    try:
        algorithm.train()
        began, actions = time.perf_counter(), 0
        while time.perf_counter() - began < seconds:
            actions += int(algorithm.train()["env_runners"]["num_env_steps_sampled"])
        return actions / (time.perf_counter() - began)
    finally:
        algorithm.stop()


def training(part: str, play: Callable[[Gateway, int], None], quick: bool) -> Iterator[Target]:
    """Compare training with a simulator with training in Python, in alternation."""
    seconds, rounds = (2.0, 1) if quick else (20.0, 3)
    config = league(is_vectorised=part == "vectorised")
    with league_of_simulators(config) as opened, local_ray(2):

        def simulated() -> float:
            with playing(opened, play, GAMES):
                return trained(opened.leagues.get(LEAGUE).config, opened.storage, seconds)

        in_python = partial(trained, config, opened.storage, seconds)
        rates = in_rounds({"simulator": simulated, "python": in_python}, rounds)
    note = f"{rates['simulator']:,.0f} and {rates['python']:,.0f} actions/s"
    ratio = rates["simulator"] / rates["python"]
    yield Target(f"training, {part}, {GAMES} games", ratio, "×", at_least=AT_LEAST, peer="Python", note=note)


def stepped(opened: Registry, games: int, seconds: float, play: Callable[[Gateway, int], None]) -> tuple[float, float]:
    """Actions per second, and processor time per action in microseconds, of a gateway whose actions are the first legal
    ones.
    """
    config = opened.leagues.get(LEAGUE).config
    simulators = ForSimulators(opened.storage, LEAGUE)
    with closing(stock_stepping(config.environment, games, simulators=simulators)) as env, playing(opened, play, GAMES):
        zeros = np.zeros((games, 2), np.int64)
        turn = env.start(lambda envs: Starts(envs, envs, zeros[envs]))
        actions, began, used = 0, 0.0, 0.0
        while True:
            if actions > 20 * GAMES and not began:
                actions, began, used = 0, time.perf_counter(), time.process_time()
            if began and time.perf_counter() - began > seconds:
                return actions / (time.perf_counter() - began), (time.process_time() - used) / actions * 1e6
            actions += sum(map(len, turn.batches.values()))
            masks = {group: batch.observations["action_mask"] for group, batch in turn.batches.items()}
            turn = env.step({group: mask.argmax(axis=1) for group, mask in masks.items()})


def protocol(quick: bool) -> Iterator[Target]:
    """Measure the gateway alone."""
    with league_of_simulators(league(is_vectorised=False)) as opened:
        rate, cost = stepped(opened, GAMES, 1.0 if quick else 10.0, repeat_one_observation)
    note = f"{rate:,.0f} actions/s"
    yield Target("processor time per action, gateway", cost, "µs", at_most=MICROSECONDS, note=note)


def slow(quick: bool) -> Iterator[Target]:
    """Measure a simulator beside a slow one."""
    seconds, rounds = (2.0, 1) if quick else (10.0, 3)
    with league_of_simulators(league(is_vectorised=False)) as opened:

        def alone() -> float:
            return stepped(opened, GAMES + 1, seconds, play_stock)[0]

        def beside() -> float:
            with playing(opened, take_a_second, 1):
                return alone()

        rates = in_rounds({"alone": alone, "beside": beside}, rounds)
    note = f"{rates['beside']:,.0f} and {rates['alone']:,.0f} actions/s"
    ratio = rates["beside"] / rates["alone"]
    yield Target("a simulator beside a slow one", ratio, "×", at_least=SLOWED, peer="alone", note=note)


PARTS: dict[str, Callable[[bool], Iterator[Target]]] = {
    "stock": partial(training, "stock", play_stock),
    "vectorised": partial(training, "vectorised", play_vectorised),
    "protocol": protocol,
    "slow": slow,
}


def main(parts: Parts = None, quick: Quick = False) -> Iterator[Target]:
    """Run the parts."""
    for part in chosen(parts, PARTS).values():
        yield from part(quick)
