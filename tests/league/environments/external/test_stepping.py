"""Episodes of simulators equal those of the same environments in Python, also where others are hostile, broken or slow:
they are refused, and nothing of theirs counts.
"""

import importlib
import itertools
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from evaluation.matches.game_loop import play_matches
from evaluation.schedules.builders import round_robin
from league.config.league import LeagueConfig
from league.environments.external import advertisement
from league.environments.external import stepping as external_stepping
from league.environments.implementation import stock_stepping
from league.environments.stepping import BatchedEnvironment, Starts, Turn, each_agent_alone
from league.errors import EnvironmentMismatch, LeagueError
from league.registry.registry import Registry
from league.registry.storage.rows import Gateway
from league.results.records import Match
from policy_league_client.endpoint import Endpoint
from policy_league_client.simulator import (
    OVER,
    TERMINATED,
    ActionRows,
    PettingZooGame,
    Play,
    Report,
    ReportBlock,
    SimulatedGame,
    Simulator,
    SimulatorConnection,
    simulate,
)
from tests.conformance.stepping import assert_stepping_conforms
from tests.support import simulators
from tests.support.environments.lockstep import CONFIG, CONTESTANTS, INTERFACE, build_roster
from tests.support.simulators import LEAGUE, NAME, VERSION, external, gateway, pettingzoo, simulating, stepping
from tests.support.waiting import until

BOARD = {"observation": np.zeros((3, 3, 2), np.int8), "action_mask": np.ones(9, np.int8)}


FIRST = Report("player_1", BOARD)


InThread = Callable[[Callable[[], object]], threading.Thread]


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(advertisement, "INTERVAL", 0.02)
    monkeypatch.setattr(external_stepping, "POLL", 0.02)


@pytest.fixture
def opened(tmp_path: Path, request: pytest.FixtureRequest, quick: None) -> Registry:
    config = external(CONFIG)
    section = config.environment.external
    assert section is not None
    limited = section.model_copy(update={"answer_seconds": getattr(request, "param", 60.0)})
    document = {"external": limited.model_dump(mode="json")}
    return simulators.registry(tmp_path, external(CONFIG, environment=document))


@pytest.fixture
def in_thread() -> Iterator[InThread]:
    """Runs simulators, which end when the environment closes their connections."""
    threads = list[threading.Thread]()

    def start(simulate: Callable[[], object]) -> threading.Thread:
        def run() -> None:
            with suppress(ConnectionClosed):
                simulate()

        threads.append(threading.Thread(target=run, daemon=True))
        threads[-1].start()
        return threads[-1]

    yield start
    for thread in threads:
        thread.join()


@pytest.fixture
def environment(opened: Registry, in_thread: InThread) -> Iterator[BatchedEnvironment]:
    with closing(stepping(opened)) as environment:
        yield environment


def connection(
    door: Gateway, episodes: int = 2, version: str = VERSION, token: str | None = None
) -> SimulatorConnection:
    endpoint = Endpoint(door.url, token or door.token, None, 60.0)
    return SimulatorConnection(endpoint, LEAGUE, NAME, version, episodes)


def started(door: Gateway) -> tuple[SimulatorConnection, list[int]]:
    """A connection, and the episodes that it is to play."""
    opened = connection(door)
    play = opened.receive()
    assert isinstance(play, Play)
    return opened, play.episodes


def until_refused(opened: SimulatorConnection) -> None:
    while True:
        opened.receive()


TICTACTOE = importlib.import_module(CONFIG.environment.entry_point).env


STOCK = pettingzoo(TICTACTOE)


def first_legal(turn: Turn) -> dict[int, np.ndarray]:
    return {group: batch.observations["action_mask"].argmax(axis=1) for group, batch in turn.batches.items()}


def until_both_act(opened: SimulatorConnection, episode: int) -> None:
    opened.report([(episode, FIRST), (episode, FIRST._replace(agent="player_2"))])
    acted = 0
    while acted < 2:
        event = opened.receive()
        acted += len(event.agents) if isinstance(event, ActionRows) else 0


def last_reports(opened: SimulatorConnection, episode: int, agents: int) -> None:
    """Of the first agents, each of which says that the episode is over."""
    board = [np.stack([BOARD[name]] * agents) for name in ("observation", "action_mask")]
    flags = np.full(agents, TERMINATED | OVER)
    opened.report_rows(ReportBlock(0, np.full(agents, episode), np.arange(agents), np.ones(agents), flags, board))


def reports_on_another_simulator(door: Gateway) -> None:
    opened, (first, *_) = started(door)
    other, _ = started(door)
    other.report([(first, FIRST)])
    with closing(opened):
        until_refused(other)


def sends_no_greeting(door: Gateway) -> None:
    headers = {"authorization": f"Bearer {door.token}"}
    with connect(f"{door.url.replace('http', 'ws')}/", additional_headers=headers) as socket:
        socket.send("{" * 1000)
        while True:
            socket.recv(60)


def reports(*rows: Report, times: int = 1, over: bool = False) -> Callable[[Gateway], None]:
    """A simulator that sends this message on the first episode that it is to play."""

    def attack(door: Gateway) -> None:
        opened, (first, *_) = started(door)
        for _ in range(times):
            opened.report([(first, report) for report in rows], [first] * over)
        until_refused(opened)

    return attack


def reports_an_unknown_episode(door: Gateway) -> None:
    opened, _ = started(door)
    opened.report([(4_000_000_000, FIRST)])
    until_refused(opened)


def ends_without_last_reports(door: Gateway) -> None:
    opened, (first, *_) = started(door)
    until_both_act(opened, first)
    last_reports(opened, first, 1)
    until_refused(opened)


def sends_too_much(door: Gateway) -> None:
    opened, _ = started(door)
    opened._connection.send(b"\1\1" + bytes(17 * 2**20))
    until_refused(opened)


def test_training_does_not_wait_for_the_first_simulator(opened: Registry) -> None:
    """It could not be ended otherwise."""
    with closing(stepping(opened, purpose="training")) as environment:
        assert not environment.start(each_agent_alone(range(16), 2)).batches
        with simulating(opened, STOCK):
            until(lambda: environment.step({}).batches)


def test_a_simulator_with_a_loop_of_its_own(
    opened: Registry, environment: BatchedEnvironment, in_thread: InThread
) -> None:
    seeds: list[int] = []

    def run() -> None:
        door = gateway(opened)
        simulator = Simulator(door.url, LEAGUE, name=NAME, version=VERSION, key=door.token, binary=False)
        for episode in itertools.islice(simulator.episodes(), 3):
            seeds.append(episode.seed)
            action = episode.act(FIRST)["player_1"]
            if len(seeds) == 2:
                continue  # without an end: the episode is abandoned
            episode.end(FIRST._replace(reward=float(action), terminated=True))

    in_thread(run)
    turn = environment.start(each_agent_alone([3, 4, 5], 2))
    returns, crashed = [], 0
    while turn.batches or len(turn.crashed):
        crashed += len(turn.crashed)
        turn = environment.step({group: np.full(len(batch), 7) for group, batch in turn.batches.items()})
        returns += [ending.reward for ending in turn.each_ending()]
    assert (returns, crashed, seeds) == ([7.0, 7.0], 1, [3, 4, 5])


def plays_on(door: Gateway) -> None:
    """Play episodes until the connection is closed. Both agents act at once, and both say that the episode is over."""
    simulator = connection(door, episodes=1)
    while True:
        event = simulator.receive()
        if isinstance(event, Play):
            until_both_act(simulator, event.episodes[0])
            last_reports(simulator, event.episodes[0], 2)


ATTACKS: list[tuple[Callable[[Gateway], object], str]] = [
    (reports_on_another_simulator, "not one of this simulator"),
    (reports_an_unknown_episode, ""),
    (reports(FIRST, FIRST), "reports twice"),
    (reports(FIRST, times=100), ""),
    (reports(FIRST._replace(terminated=True), over=True), "before anybody has acted"),
    (ends_without_last_reports, "has no last report"),
    (reports(FIRST._replace(reward=float("nan"))), "finite"),
    (lambda door: connection(door, version="9"), "expects 'game' of version '1.2'"),
    (lambda door: connection(door, token="x" * 32), "401"),
    (sends_too_much, ""),
    (sends_no_greeting, ""),
]
"""What a simulator does, and why it is refused."""


def test_hostile_simulators_are_refused_and_change_nothing(
    opened: Registry, environment: BatchedEnvironment, in_thread: InThread
) -> None:
    play, expected = tournament(12)
    refusals: list[str] = []

    def attack() -> None:
        door = gateway(opened)
        for hostile, _ in ATTACKS:
            try:
                hostile(door)
            except (LeagueError, ConnectionClosed, InvalidStatus, TimeoutError) as error:
                refusals.append(str(error))

    attacker = in_thread(attack)
    with simulating(opened, STOCK, episodes=2):
        while attacker.is_alive():
            assert play(environment) == expected
    for refusal, (_, reason) in zip(refusals, ATTACKS, strict=True):
        assert reason in refusal


def test_a_slow_simulator_delays_nobody(opened: Registry, environment: BatchedEnvironment, in_thread: InThread) -> None:
    """Turns contain what has been reported, while an episode of another simulator waits for its report."""
    acting: list[set[int]] = []
    with simulating(opened, STOCK, episodes=7):
        in_thread(lambda: started(gateway(opened)))
        turn = environment.start(each_agent_alone(range(10_000), 2))
        while len(acting) < 50:
            acting.append(set(np.flatnonzero(turn.acting(8))))
            turn = environment.step(first_legal(turn))
    assert any(len(envs) < 8 for envs in acting)
    assert len(set().union(*acting)) >= 6


def test_a_simulator_that_leaves_before_anybody_acts_costs_nothing(
    opened: Registry, environment: BatchedEnvironment, in_thread: InThread
) -> None:
    """Its reports are dropped, and if nobody has seen them its episode goes to the next one."""

    def run() -> None:
        door = gateway(opened)
        leaving, (episode, *_) = started(door)
        leaving.report([(episode, FIRST)])
        leaving.close()
        plays_on(door)

    in_thread(run)
    rewards, lost = play_out(environment, 3)
    assert len(rewards) == 2 * (3 - lost), "its episode is lost only if its reports were in a turn"
    assert play_out(environment, 5) == ([1.0] * 10, 0), "each last report may say that the episode is over"


@pytest.mark.parametrize("opened", [0.3], indirect=True)
def test_a_simulator_that_hangs_beside_a_fast_one_is_disconnected(
    opened: Registry, environment: BatchedEnvironment, in_thread: InThread
) -> None:
    """Episodes that the fast one loses, because it is late on a busy machine, are begun again."""
    refusal: list[str] = []

    def hang() -> None:
        try:
            until_refused(started(gateway(opened))[0])
        except ConnectionClosed as error:
            refusal.append(str(error))

    hanging = in_thread(hang)
    with simulating(opened, STOCK, episodes=4):
        turn = environment.start(each_agent_alone(itertools.count(), 2))
        while hanging.is_alive():
            turn = environment.step(first_legal(turn))
    assert "has not reported for 0.3 s" in refusal[0]


def test_an_error_of_ours_ends_the_tournament(opened: Registry, environment: BatchedEnvironment) -> None:
    """It is not blamed on the simulator whose message came before."""
    seeds = iter([[1] * 8])

    def next_episodes(envs: np.ndarray) -> Starts:
        for first in seeds:
            return Starts(envs, np.array(first), np.zeros((8, 2), np.int64))
        raise EnvironmentMismatch("no more seeds")

    def play_on() -> None:
        turn = environment.start(next_episodes)
        while True:
            turn = environment.step(first_legal(turn))

    with simulating(opened, STOCK, episodes=4), pytest.raises(EnvironmentMismatch, match="no more seeds"):
        play_on()


def test_a_simulator_that_abandons_everything_is_refused(
    opened: Registry, environment: BatchedEnvironment, in_thread: InThread
) -> None:
    refusal: list[str] = []

    def give_up() -> None:
        quitter, episodes = started(gateway(opened))
        try:
            while True:
                quitter.abandon(episodes)
                event = quitter.receive()
                episodes = event.episodes if isinstance(event, Play) else []
        except (LeagueError, ConnectionClosed) as error:
            refusal.append(str(error))
        plays_on(gateway(opened))

    in_thread(give_up)
    assert play_out(environment, 2) == ([1.0] * 4, 0)
    assert "has abandoned 21 consecutive episodes" in refusal[0]


def play_out(environment: BatchedEnvironment, episodes: int) -> tuple[list[float], int]:
    """The rewards of last reports in some episodes, and how many episodes were lost."""
    turn = environment.start(each_agent_alone(range(episodes), 2))
    rewards, lost = list[float](), 0
    while turn.batches or len(turn.crashed):
        turn = environment.step({group: np.zeros(len(batch), np.int64) for group, batch in turn.batches.items()})
        rewards += [ending.reward for ending in turn.each_ending()]
        lost += len(turn.crashed)
    return rewards, lost


def test_an_episode_is_over_after_all_have_left(
    opened: Registry, environment: BatchedEnvironment, in_thread: InThread
) -> None:
    def run() -> None:
        door = gateway(opened)
        simulator = Simulator(door.url, LEAGUE, name=NAME, version=VERSION, key=door.token)
        for episode in itertools.islice(simulator.episodes(), 3):
            episode.act(FIRST)
            episode.act(FIRST._replace(reward=1.0, terminated=True))
            episode.end()

    in_thread(run)
    assert play_out(environment, 3) == ([1.0] * 3, 0)


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize(
    ("module", "function", "kwargs", "binary", "count"),
    [
        ("pettingzoo.classic.tictactoe_v3", "env", {}, True, 2),
        ("pettingzoo.classic.texas_holdem_no_limit_v6", "env", {"num_players": 3}, False, 3),
        ("pettingzoo.classic.rps_v2", "parallel_env", {"max_cycles": 6}, True, 1),
        ("mpe2.simple_world_comm_v3", "parallel_env", {"continuous_actions": True, "max_cycles": 8}, False, 2),
        ("mpe2.simple_world_comm_v3", "parallel_env", {"continuous_actions": True, "max_cycles": 8}, True, 1),
    ],
)
def test_episodes_equal_the_plain_loop(
    module: str, function: str, kwargs: dict[str, Any], binary: bool, count: int, tmp_path: Path
) -> None:
    create = partial(getattr(importlib.import_module(module), function), **kwargs)
    config = LeagueConfig.from_mapping({"league": "stock", "environment": {"entry_point": module, "kwargs": kwargs}})
    opened = simulators.registry(tmp_path, external(config))
    with closing(stepping(opened, 3)) as environment:  # noqa: SIM117  it outlives the simulators
        with simulating(opened, pettingzoo(create), episodes=2, binary=binary, count=count):
            assert_stepping_conforms(lambda _: environment, create, seeds=[11, 12, 13, 14, 15, 16], num_envs=3)


def tournament(blocks: int) -> tuple[Callable[[BatchedEnvironment], list[Match]], list[Match]]:
    """A function that plays a tournament in an environment, and its matches in Python."""
    schedule = round_robin(CONFIG, INTERFACE, CONTESTANTS, blocks)

    def play(environment: BatchedEnvironment) -> list[Match]:
        return play_matches(schedule, range(schedule.length), environment, INTERFACE, build_roster())

    return play, play(stock_stepping(CONFIG.environment, 8))


def test_matches_are_those_of_the_game_in_python(opened: Registry, environment: BatchedEnvironment) -> None:
    play, expected = tournament(4)
    with simulating(opened, STOCK, episodes=3, count=2):
        for _ in range(2):  # the gateway stays open between two tournaments
            assert play(environment) == expected


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
def test_games_of_simulators_that_die_are_repeated(
    opened: Registry, environment: BatchedEnvironment, deaths: int
) -> None:
    play, expected = tournament(4 if deaths < 10 else 80)
    steps = iter([*range(2, 2 + 3 * deaths, 3)][:deaths] if deaths < 10 else [5 + i % 20 for i in range(deaths)])
    died = []

    def run() -> None:
        """One program after the other: each ends in the middle of its games."""
        with suppress(LeagueError, TimeoutError):
            door = gateway(opened)
            for mortal in steps:
                try:
                    simulate_on(door, lambda: Mortal(TICTACTOE(), mortal))  # noqa: B023  it is called at once
                except Crash:
                    died.append(mortal)
            simulate_on(door, STOCK)

    def simulate_on(door: Gateway, make_game: Callable[[], SimulatedGame]) -> None:
        simulate(door.url, LEAGUE, make_game, name=NAME, version=VERSION, key=door.token, episodes=3)

    threading.Thread(target=run, daemon=True).start()
    assert play(environment) == expected
    assert len(died) == deaths
