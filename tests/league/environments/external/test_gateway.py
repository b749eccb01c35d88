"""A gateway among hostile, broken and slow simulators: they are refused, and nothing of theirs counts."""

import importlib
import itertools
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from evaluation.matches.game_loop import play_matches
from evaluation.schedules.builders import round_robin
from league.environments.external import advertisement
from league.environments.external import stepping as external_stepping
from league.environments.lockstep import stock_stepping
from league.environments.stepping import BatchedEnvironment, Starts, Turn, each_agent_alone
from league.errors import EnvironmentMismatch, LeagueError
from league.registry.gateways import Gateway
from league.registry.registry import Registry
from policy_league_client.endpoint import Endpoint
from policy_league_client.simulator import (
    OVER,
    TERMINATED,
    ActionRows,
    Play,
    Report,
    ReportBlock,
    Simulator,
    SimulatorConnection,
)
from tests.support import simulators
from tests.support.environments.lockstep import CONFIG, CONTESTANTS, INTERFACE, build_roster
from tests.support.simulators import LEAGUE, NAME, VERSION, external, gateway, pettingzoo, simulating, stepping

BOARD = {"observation": np.zeros((3, 3, 2), np.int8), "action_mask": np.ones(9, np.int8)}
FIRST = Report("player_1", BOARD)

InThread = Callable[[Callable[[], object]], threading.Thread]


@pytest.fixture
def opened(tmp_path: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Registry:
    monkeypatch.setattr(advertisement, "INTERVAL", 0.02)
    monkeypatch.setattr(external_stepping, "POLL", 0.02)
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


def reports_on_another_simulator(door: Gateway) -> None:
    opened, (first, *_) = started(door)
    other, _ = started(door)
    other.report([(first, FIRST)])
    with closing(opened):
        until_refused(other)


def reports_an_unknown_episode(door: Gateway) -> None:
    opened, _ = started(door)
    opened.report([(4_000_000_000, FIRST)])
    until_refused(opened)


def reports_twice(door: Gateway) -> None:
    opened, (first, *_) = started(door)
    opened.report([(first, FIRST), (first, FIRST)])
    until_refused(opened)


def reports_before_the_action(door: Gateway) -> None:
    opened, (first, *_) = started(door)
    for _ in range(100):
        opened.report([(first, FIRST)])
    until_refused(opened)


def ends_without_an_action(door: Gateway) -> None:
    opened, (first, *_) = started(door)
    opened.report([(first, FIRST._replace(terminated=True))], [first])
    until_refused(opened)


def ends_without_last_reports(door: Gateway) -> None:
    opened, (first, *_) = started(door)
    opened.report([(first, FIRST), (first, FIRST._replace(agent="player_2"))])
    acted = 0
    while acted < 2:
        event = opened.receive()
        acted += len(event.agents) if isinstance(event, ActionRows) else 0
    rows = 0, np.array([first]), np.array([0]), np.array([1.0]), np.array([TERMINATED | OVER])
    opened.report_rows(ReportBlock(*rows, [BOARD["observation"][np.newaxis], BOARD["action_mask"][np.newaxis]]))
    until_refused(opened)


def reports_nan(door: Gateway) -> None:
    opened, (first, *_) = started(door)
    opened.report([(first, FIRST._replace(reward=float("nan")))])
    until_refused(opened)


def has_another_version(door: Gateway) -> None:
    connection(door, version="9")


def has_another_token(door: Gateway) -> None:
    connection(door, token="x" * 32)


def sends_too_much(door: Gateway) -> None:
    opened, _ = started(door)
    opened._connection.send(b"\1\1" + bytes(17 * 2**20))
    until_refused(opened)


def sends_no_greeting(door: Gateway) -> None:
    headers = {"authorization": f"Bearer {door.token}"}
    with connect(f"{door.url.replace('http', 'ws')}/", additional_headers=headers) as socket:
        socket.send("{" * 1000)
        while True:
            socket.recv(60)


ATTACKS: list[Callable[[Gateway], None]] = [
    reports_on_another_simulator,
    reports_an_unknown_episode,
    reports_twice,
    reports_before_the_action,
    ends_without_an_action,
    ends_without_last_reports,
    reports_nan,
    has_another_version,
    has_another_token,
    sends_too_much,
    sends_no_greeting,
]


def test_hostile_simulators_are_refused_and_change_nothing(
    opened: Registry, environment: BatchedEnvironment, in_thread: InThread
) -> None:
    schedule = round_robin(CONFIG, INTERFACE, CONTESTANTS, 12)
    positions = range(schedule.length)
    expected = play_matches(schedule, positions, stock_stepping(CONFIG.environment, 8), INTERFACE, build_roster())
    refusals: dict[str, str] = {}

    def attack() -> None:
        door = gateway(opened)
        for hostile in ATTACKS:
            try:
                hostile(door)
            except (LeagueError, ConnectionClosed, InvalidStatus, TimeoutError) as error:
                refusals[hostile.__name__] = str(error)

    attacker = in_thread(attack)
    with simulating(opened, pettingzoo(importlib.import_module(CONFIG.environment.entry_point).env), episodes=2):
        while attacker.is_alive():
            assert play_matches(schedule, positions, environment, INTERFACE, build_roster()) == expected
    assert refusals.keys() == {attack.__name__ for attack in ATTACKS}
    assert "not one of this simulator" in refusals["reports_on_another_simulator"]
    assert "reports twice" in refusals["reports_twice"]
    assert "before anybody has acted" in refusals["ends_without_an_action"]
    assert "has no last report" in refusals["ends_without_last_reports"]
    assert "finite" in refusals["reports_nan"]
    assert "expects 'game' of version '1.2'" in refusals["has_another_version"]
    assert "401" in refusals["has_another_token"]


def test_a_slow_simulator_delays_nobody(opened: Registry, environment: BatchedEnvironment, in_thread: InThread) -> None:
    """Turns contain what has been reported, while an episode of another simulator waits for its report."""
    turns = []
    with simulating(opened, pettingzoo(importlib.import_module(CONFIG.environment.entry_point).env), episodes=7):

        def next_turns() -> None:
            turn = environment.start(each_agent_alone(range(10_000), 2))
            while len(turns) < 50:
                turns.append(turn)
                acts = {
                    group: batch.observations["action_mask"].argmax(axis=1) for group, batch in turn.batches.items()
                }
                turn = environment.step(acts)

        in_thread(lambda: started(gateway(opened)))
        next_turns()
    acting = [set(np.flatnonzero(turn.acting(8))) for turn in turns]
    assert any(len(envs) < 8 for envs in acting)
    assert len(set().union(*acting)) >= 6


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


def ends_twice(opened: SimulatorConnection, episode: int) -> None:
    """Both agents act at once, and both last reports say that the episode is over."""
    opened.report([(episode, FIRST), (episode, FIRST._replace(agent="player_2"))])
    acted = 0
    while acted < 2:
        event = opened.receive()
        acted += len(event.agents) if isinstance(event, ActionRows) else 0
    board = [np.stack([BOARD[name]] * 2) for name in ("observation", "action_mask")]
    flags = np.full(2, TERMINATED | OVER)
    opened.report_rows(ReportBlock(0, np.full(2, episode), np.arange(2), np.ones(2), flags, board))


def plays_on(door: Gateway) -> None:
    """Play episodes until the connection is closed."""
    simulator = connection(door, episodes=1)
    while True:
        event = simulator.receive()
        if isinstance(event, Play):
            ends_twice(simulator, event.episodes[0])


def test_each_last_report_may_say_that_the_episode_is_over(
    opened: Registry, environment: BatchedEnvironment, in_thread: InThread
) -> None:
    in_thread(lambda: plays_on(gateway(opened)))
    assert play_out(environment, 5) == ([1.0] * 10, 0)


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
    make = importlib.import_module(CONFIG.environment.entry_point).env
    with simulating(opened, pettingzoo(make), episodes=4):
        turn = environment.start(each_agent_alone(itertools.count(), 2))
        while hanging.is_alive():
            masks = {group: batch.observations["action_mask"] for group, batch in turn.batches.items()}
            turn = environment.step({group: mask.argmax(axis=1) for group, mask in masks.items()})
    assert "has not reported for 0.3 s" in refusal[0]


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


def test_an_error_of_ours_ends_the_tournament(opened: Registry, environment: BatchedEnvironment) -> None:
    """It is not blamed on the simulator whose message came before."""
    make = importlib.import_module(CONFIG.environment.entry_point).env
    seeds = iter([[1] * 8])

    def next_episodes(envs: np.ndarray) -> Starts:
        for first in seeds:
            return Starts(envs, np.array(first), np.zeros((8, 2), np.int64))
        raise EnvironmentMismatch("no more seeds")

    with simulating(opened, pettingzoo(make), episodes=4):
        turn = environment.start(next_episodes)

        def play_on(turn: Turn) -> None:
            while True:
                masks = {group: batch.observations["action_mask"] for group, batch in turn.batches.items()}
                turn = environment.step({group: mask.argmax(axis=1) for group, mask in masks.items()})

        with pytest.raises(EnvironmentMismatch, match="no more seeds"):
            play_on(turn)


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
