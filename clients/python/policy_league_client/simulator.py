"""Simulators: games that run in programs of their own, and play episodes for training runs and evaluations.

    simulate("http://127.0.0.1:8000", "bomberman", MyGame, name="bomberman", version="1.2", key="plk_…")

A simulator connects to a server and receives episodes, each with a seed. It reports what agents observe, and receives
their actions. `simulate` drives objects with `reset` and `step`; a game with a loop of its own uses `Simulator`.
The messages are described in the documentation under "Simulators".
"""

import os
import struct
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from math import prod
from typing import Any, NamedTuple, Protocol

import httpx
import numpy as np
import orjson
from numpy.typing import NDArray
from websockets.exceptions import ConnectionClosed, InvalidStatus

from policy_league_client.endpoint import DEFAULT_URL, Endpoint
from policy_league_client.errors import InvalidInput, RemoteError, one_line
from policy_league_client.refs import check_slug
from policy_league_client.requests import encode
from policy_league_client.retries import MAX_DELAY, NOT_READY_DEADLINE, parse_error, parse_object, retry_deadline
from policy_league_client.stream_protocol import CONNECTION_ERRORS, PERMANENT_CLOSE_CODES
from policy_league_client.transport import Connection, connect, receive

PROTOCOL = 1
"""Version of the protocol, which both sides send first."""
HEADER = struct.Struct("<BBHI")
"""Binary messages begin with the version of the protocol, their kind, the number of a layout, and of rows."""
REPORTS, ACTIONS = 1, 2
"""Kinds of binary messages."""
COLUMNS = (np.dtype("<f8"), np.dtype("<u4"), np.dtype("<u2"), np.dtype("u1"))
"""Of rewards, episodes, agents and flags in a binary message."""
TERMINATED, TRUNCATED, OVER = 1, 2, 4
"""Flags of a report: the agent's last one, and why; the last one of its episode."""
WAIT = 5.0
"""Seconds between two attempts to connect while nothing waits for simulators."""
MESSAGE_BYTES = 2**20
"""Bytes of observations after which another message begins, with another episode: a server takes 4 MiB."""
QUIET = 3600.0
"""Seconds without a message after which a connection counts as lost. The server sends pings."""


class Report(NamedTuple):
    """What an agent is told. Without a flag the agent must act next; with one, it has left the episode.

    Attributes:
        agent: Name of the agent.
        observation: In the agent's observation space: an array, a number, or a dict of these.
        reward: Sum of the agent's rewards since its previous report.
        terminated: Whether the agent has left because of the rules of the game.
        truncated: Whether it has left for another reason, such as a time limit.
    """

    agent: str
    observation: Any
    reward: float = 0.0
    terminated: bool = False
    truncated: bool = False


class SimulatedGame(Protocol):
    """A game that `simulate` drives. An episode is over when no agent must act."""

    def reset(self, seed: int) -> Iterable[Report]:
        """Start an episode: the reports of the agents that must act first."""

    def step(self, actions: Mapping[str, Any]) -> Iterable[Report]:
        """Continue with the actions of all agents that must act: the next reports, and those of agents that leave.

        At the end of an episode each agent that has acted gets a last report.
        """


@dataclass(frozen=True, slots=True)
class AgentLayout:
    """Agents with equal spaces, and how binary messages represent these.

    Attributes:
        agents: Their names.
        inputs: For each array of an observation its path of keys, dtype and shape.
        action: The dtype and the shape of an action.
    """

    agents: tuple[str, ...]
    inputs: tuple[tuple[tuple[str, ...], np.dtype[Any], tuple[int, ...]], ...]
    action: tuple[np.dtype[Any], tuple[int, ...]]

    @property
    def row_bytes(self) -> int:
        """Bytes of an observation."""
        return sum(dtype.itemsize * prod(shape) for _, dtype, shape in self.inputs)


class ReportBlock(NamedTuple):
    """The reports of k agents with equal spaces.

    Attributes:
        layout: Number of the layout.
        episodes: Numbers of the episodes, (k,).
        agents: Indices of the agents, (k,).
        rewards: (k,).
        flags: TERMINATED, TRUNCATED and OVER, (k,).
        inputs: The arrays of the layout, (k, …) each.
    """

    layout: int
    episodes: NDArray
    agents: NDArray
    rewards: NDArray
    flags: NDArray
    inputs: Sequence[NDArray]


class Play(NamedTuple):
    """Episodes to start: their numbers and seeds."""

    episodes: list[int]
    seeds: list[int]


class ActionRows(NamedTuple):
    """Actions: row i is for an agent in an episode. agents: indices into `SimulatorConnection.agents`."""

    layout: int
    episodes: NDArray[np.uint32]
    agents: NDArray[np.uint16]
    actions: NDArray


class Abandon(NamedTuple):
    """Episodes that nobody waits for any more."""

    episodes: list[int]


Event = Play | ActionRows | Abandon


class SimulatorConnection:
    """A connection of a simulator, for games that report whole arrays. Others use `simulate` or `Simulator`.

    Attributes:
        agents: Names of the agents, which messages refer to by index.
        layouts: The layouts of observations and actions.
    """

    def __init__(
        self, endpoint: Endpoint, league: str, name: str, version: str, episodes: int, binary: bool = True
    ) -> None:
        """Connect. Raises LeagueError if the server refuses, and one of CONNECTION_ERRORS.

        Args:
            endpoint: The server.
            league: The league.
            name: Name of the simulator.
            version: Its version.
            episodes: Number of episodes that it plays at the same time.
            binary: Use binary messages for reports and actions.
        """
        url = f"{endpoint.websocket_url}/v1/leagues/{check_slug('league', league)}/simulate"
        self._connection: Connection = connect(url, endpoint.headers, endpoint.timeout)
        self._binary = binary
        self._send(
            type="hello",
            protocol=PROTOCOL,
            simulator={"name": name, "version": version},
            episodes=episodes,
            binary=binary,
        )
        welcome = self._object(receive(self._connection, endpoint.timeout))
        if welcome.get("type") != "welcome":
            raise RemoteError(f"{url} answered with the message {str(welcome)[:200]}, expected a welcome")
        self._read_welcome(welcome)

    def _read_welcome(self, welcome: Mapping[str, Any]) -> None:
        self.agents: tuple[str, ...] = tuple(welcome["agents"])
        self.layouts = [
            AgentLayout(
                tuple(layout["agents"]),
                tuple(
                    (tuple(part["path"]), np.dtype(part["dtype"]).newbyteorder("<"), tuple(part["shape"]))
                    for part in layout["inputs"]
                ),
                (np.dtype(layout["action"]["dtype"]).newbyteorder("<"), tuple(layout["action"]["shape"])),
            )
            for layout in welcome["layouts"]
        ]
        self.layout_of = {agent: number for number, layout in enumerate(self.layouts) for agent in layout.agents}
        self.index_of = {agent: index for index, agent in enumerate(self.agents)}

    def receive(self) -> Event:
        """Wait for the next message. Raises LeagueError, or one of CONNECTION_ERRORS if the connection is lost."""
        message = receive(self._connection, QUIET)
        if isinstance(message, bytes):
            return self._action_rows(message)
        document = self._object(message)
        match document.get("type"):
            case "play":
                starts = document["episodes"]
                return Play([start["episode"] for start in starts], [start["seed"] for start in starts])
            case "actions":
                rows = document["actions"]
                layout = self.layout_of[rows[0]["agent"]]
                dtype, _ = self.layouts[layout].action
                return ActionRows(
                    layout,
                    np.array([row["episode"] for row in rows], np.uint32),
                    np.array([self.index_of[row["agent"]] for row in rows], np.uint16),
                    np.array([row["action"] for row in rows], dtype),
                )
            case "abandon":
                return Abandon(document["episodes"])
            case other:
                raise RemoteError(f"the server sent a message of the unknown type {str(other)[:64]!r}")

    def report_rows(self, *blocks: ReportBlock) -> None:
        """Send the reports of many agents in one binary message.

        Agents that act at once in an episode belong into one message, with a block for each layout.
        """
        parts = list[bytes]()
        for block in blocks:
            parts.append(HEADER.pack(PROTOCOL, REPORTS, block.layout, len(block.episodes)))
            columns: list[NDArray] = [block.rewards, block.episodes, block.agents, block.flags, *block.inputs]
            dtypes: list[np.dtype[Any]] = [*COLUMNS, *(dtype for _, dtype, _ in self.layouts[block.layout].inputs)]
            parts += [np.asarray(column, dtype).tobytes() for column, dtype in zip(columns, dtypes, strict=True)]
        self._connection.send(b"".join(parts))

    def report(self, reports: Iterable[tuple[int, Report]], over: Iterable[int] = ()) -> None:
        """Send reports of episodes, and which of these are over with them. Raises InvalidInput."""
        reports, over = list(reports), set(over)
        if not self._binary:
            self._send(type="reports", reports=[_document(*report) for report in reports], over=sorted(over))
            return
        last = {episode: row for row, (episode, _) in enumerate(reports)}
        ending = {last[episode] for episode in over if episode in last}
        by_layout: dict[int, list[tuple[int, Report, int]]] = {}
        size = 0
        for row, (episode, report) in enumerate(reports):
            layout = self._layout(report.agent)
            if size > MESSAGE_BYTES and reports[row - 1][0] != episode:
                self.report_rows(*(self._encoded(number, part) for number, part in by_layout.items()))
                by_layout, size = {}, 0
            by_layout.setdefault(layout, []).append((episode, report, OVER if row in ending else 0))
            size += self.layouts[layout].row_bytes
        if by_layout:
            self.report_rows(*(self._encoded(number, part) for number, part in by_layout.items()))
        if silent := over - last.keys():  # all of their agents had left before
            self._send(type="reports", reports=[], over=sorted(silent))

    def abandon(self, episodes: Iterable[int]) -> None:
        """Tell the server that the simulator cannot finish episodes. They are lost, not counted as anybody's."""
        self._send(type="abandon", episodes=list(episodes))

    def close(self) -> None:
        """Close the connection. Episodes that are not over are lost."""
        self._connection.close()

    def _layout(self, agent: str) -> int:
        if agent not in self.layout_of:
            raise InvalidInput(f"{agent!r} is no agent of the league, expected one of {', '.join(self.agents)}")
        return self.layout_of[agent]

    def _encoded(self, number: int, reports: Sequence[tuple[int, Report, int]]) -> ReportBlock:
        inputs = []
        for path, dtype, shape in self.layouts[number].inputs:
            name = ".".join(("observation", *path))
            try:
                values = np.array([_at(report.observation, path) for _, report, _ in reports], dtype)
            except (KeyError, TypeError, ValueError, OverflowError) as error:
                raise InvalidInput(
                    f"{name} is no {dtype.name} of shape {list(shape)} for each report: {one_line(error)}"
                ) from error
            if values.shape != (len(reports), *shape):
                raise InvalidInput(f"{name} has shape {list(values.shape[1:])}, expected {list(shape)}")
            inputs.append(values)
        return ReportBlock(
            number,
            np.array([episode for episode, _, _ in reports]),
            np.array([self.index_of[report.agent] for _, report, _ in reports]),
            np.array([report.reward for _, report, _ in reports]),
            np.array(
                [report.terminated * TERMINATED + report.truncated * TRUNCATED + over for _, report, over in reports]
            ),
            inputs,
        )

    def _action_rows(self, message: bytes) -> ActionRows:
        _, kind, layout, rows = HEADER.unpack_from(message)
        if kind != ACTIONS:
            raise RemoteError(f"the server sent a binary message of the unknown kind {kind}")
        dtype, shape = self.layouts[layout].action
        at = HEADER.size
        episodes = np.frombuffer(message, "<u4", rows, at)
        agents = np.frombuffer(message, "<u2", rows, at + 4 * rows)
        actions = np.frombuffer(message, dtype, offset=at + 6 * rows).reshape(rows, *shape)
        return ActionRows(layout, episodes, agents, actions)

    def _object(self, message: str | bytes) -> dict[str, Any]:
        document = parse_object(message)
        if document is None:
            raise RemoteError(f"the server sent no JSON object: {message[:200]!r}")
        if document.get("type") == "error":
            raise InvalidInput(str(document.get("message")))
        return document

    def _send(self, **document: Any) -> None:
        self._connection.send(orjson.dumps(document).decode())


class SimulatedEpisode:
    """An episode that a `Simulator` plays.

    Attributes:
        number: Its number.
        seed: Determines the game's own randomness.
        is_abandoned: Whether nobody waits for it any more: the connection was lost, or the server has given it up.
    """

    def __init__(self, connection: SimulatorConnection, number: int, seed: int) -> None:
        self._connection = connection
        self.number, self.seed = number, seed
        self.is_abandoned = self.is_over = False

    def act(self, *reports: Report) -> dict[str, Any]:
        """Report what agents observe, and wait for the actions of those that must act: agent → action.

        Raises EpisodeAbandoned if nobody waits for the episode any more, and LeagueError if a report is invalid.
        """
        waiting = {report.agent for report in reports if not (report.terminated or report.truncated)}
        actions: dict[str, Any] = {}
        try:
            self._connection.report((self.number, report) for report in reports)
            while waiting - actions.keys():
                event = self._connection.receive()
                if isinstance(event, ActionRows):
                    actions |= {agent: action for _, agent, action in _by_agent(self._connection, event)}
                elif isinstance(event, Abandon) and self.number in event.episodes:
                    self.is_abandoned = True
                    raise EpisodeAbandoned(f"the server waits for episode {self.number} no longer")
        except CONNECTION_ERRORS as error:
            self.is_abandoned = True
            _raise_if_permanent(error)
            raise EpisodeAbandoned(f"the connection was lost in episode {self.number}: {one_line(error)}") from error
        return actions

    def end(self, *reports: Report) -> None:
        """End the episode with the last report of each agent that has acted and not left before."""
        try:
            self._connection.report([(self.number, report) for report in reports], [self.number])
            self.is_over = True
        except CONNECTION_ERRORS as error:  # the episode is lost, as `episodes` will notice
            self.is_abandoned = True
            _raise_if_permanent(error)


class EpisodeAbandoned(Exception):
    """Nobody waits for the episode any more: end it, and begin the next one."""


class Simulator:
    """A simulator that plays one episode at a time in a loop of its own.

        simulator = Simulator("http://127.0.0.1:8000", "race", name="race", version="1.2")
        for episode in simulator.episodes():
            car = Car(episode.seed)
            try:
                while not car.has_arrived:
                    car.steer(episode.act(Report("car", car.camera, car.progress))["car"])
            except EpisodeAbandoned:  # nobody waits for it any more
                continue
            episode.end(Report("car", car.camera, car.progress, terminated=True))

    Args:
        url: The server's address, by default that of a server on this machine.
        league: The league.
        name: Name of the simulator, `environment.external.simulator` of the league.
        version: Its version, `environment.external.version` of the league.
        key: API key with the scope `simulate`; default: the environment variable LEAGUE_API_KEY.
        binary: Use binary messages, which are faster; JSON is easier to read.
        timeout: Seconds to connect.
        stop: Ends the simulator when it is set, after the message for which it waits.
    """

    def __init__(
        self,
        url: str | None,
        league: str,
        *,
        name: str,
        version: str,
        key: str | None = None,
        binary: bool = True,
        timeout: float = 10.0,
        stop: threading.Event | None = None,
    ) -> None:
        self._stop = stop or threading.Event()
        endpoint = Endpoint(url or os.environ.get("LEAGUE_URL") or DEFAULT_URL, key, None, timeout)
        self._connect = partial(SimulatorConnection, endpoint, league, name, version, binary=binary)

    def connected(self, episodes: int = 1) -> Iterator[SimulatorConnection]:
        """Yield connections until `stop` is set, each after the previous one was lost, or nothing needed simulators.

        episodes: number of episodes that are played at the same time. Raises LeagueError if the server refuses.
        """
        delay = MAX_DELAY
        while not self._stop.is_set():
            try:
                connection = self._connect(episodes)
            except CONNECTION_ERRORS as error:
                _raise_if_permanent(error)
                self._stop.wait(delay)
                delay = min(2 * delay, WAIT)
                continue
            delay = MAX_DELAY
            try:
                yield connection
            finally:
                with suppress(*CONNECTION_ERRORS):
                    connection.close()

    def episodes(self) -> Iterator[SimulatedEpisode]:
        """Yield the episodes to play, one after the other, until `stop` is set.

        Raises LeagueError if the server refuses the simulator or a report.
        """
        for connection in self.connected():
            try:
                while True:
                    event = connection.receive()
                    if isinstance(event, Play):
                        for number, seed in zip(*event, strict=True):
                            episode = SimulatedEpisode(connection, number, seed)
                            yield episode
                            if not (episode.is_over or episode.is_abandoned):
                                connection.abandon([number])
            except CONNECTION_ERRORS as error:
                _raise_if_permanent(error)


def simulate(
    url: str | None,
    league: str,
    make_game: Callable[[], SimulatedGame],
    *,
    name: str,
    version: str,
    key: str | None = None,
    episodes: int = 1,
    binary: bool = True,
    limit: int | None = None,
    stop: threading.Event | None = None,
) -> None:
    """Play episodes for a league, until `limit` of them are over; by default for ever.

    The connection is opened again whenever it is lost; episodes that were in progress are lost with it. While nothing
    waits for simulators, it tries again every few seconds.

    Args:
        url: See `Simulator`.
        league: See `Simulator`.
        make_game: Creates a game. Each plays one episode after the other.
        name: See `Simulator`.
        version: See `Simulator`.
        key: See `Simulator`.
        episodes: Number of games that are played at the same time.
        binary: See `Simulator`.
        limit: Number of episodes after which to stop.
        stop: See `Simulator`.

    Raises:
        LeagueError: The server refuses the simulator, or a report is invalid.
    """
    stop = stop or threading.Event()
    simulator = Simulator(url, league, name=name, version=version, key=key, binary=binary, stop=stop)
    remaining = float("inf") if limit is None else limit
    spare: list[SimulatedGame] = []
    for connection in simulator.connected(episodes):
        table = _Table(connection, make_game, spare)
        try:
            while remaining > 0 and not stop.is_set():
                remaining -= table.process(connection.receive())
            return
        except CONNECTION_ERRORS as error:
            _raise_if_permanent(error)
        finally:
            spare = table.games()


class _Table:
    """The games of one connection."""

    def __init__(
        self, connection: SimulatorConnection, make_game: Callable[[], SimulatedGame], spare: list[SimulatedGame]
    ) -> None:
        self._connection, self._make_game, self._spare = connection, make_game, spare
        self._playing: dict[int, tuple[SimulatedGame, dict[str, Any]]] = {}
        """Episode → its game, and the actions that have arrived."""
        self._waiting: dict[int, set[str]] = {}
        """Episode → the agents whose actions have not arrived."""

    def games(self) -> list[SimulatedGame]:
        """Return all games, for the next connection."""
        return [*self._spare, *(game for game, _ in self._playing.values())]

    def process(self, event: Event) -> int:
        """Process a message. Return the number of episodes that are over with it."""
        reports: list[tuple[int, Report]] = []
        over: list[int] = []
        match event:
            case Play():
                for episode, seed in zip(*event, strict=True):
                    game = self._spare.pop() if self._spare else self._make_game()
                    self._playing[episode] = game, {}
                    self._read(episode, game.reset(seed), reports, over)
            case ActionRows():
                for episode, agent, action in _by_agent(self._connection, event):
                    if episode not in self._playing:
                        continue  # it has been abandoned
                    game, actions = self._playing[episode]
                    actions[agent] = action
                    self._waiting[episode].discard(agent)
                    if not self._waiting[episode]:
                        self._playing[episode] = game, {}
                        self._read(episode, game.step(actions), reports, over)
            case Abandon():
                for episode in event.episodes:
                    self._free(episode)
        if reports:
            self._connection.report(reports, over)
        for episode in over:
            self._free(episode)
        return len(over)

    def _read(
        self, episode: int, returned: Iterable[Report], reports: list[tuple[int, Report]], over: list[int]
    ) -> None:
        rows = list(returned)
        reports += [(episode, report) for report in rows]
        self._waiting[episode] = {report.agent for report in rows if not (report.terminated or report.truncated)}
        if not self._waiting[episode]:
            over.append(episode)

    def _free(self, episode: int) -> None:
        if episode in self._playing:
            self._spare.append(self._playing.pop(episode)[0])
            self._waiting.pop(episode, None)


def _by_agent(connection: SimulatorConnection, rows: ActionRows) -> Iterator[tuple[int, str, Any]]:
    """Yield episode, agent and action of each row: numbers as int, others as arrays."""
    _, shape = connection.layouts[rows.layout].action
    actions = rows.actions if shape else rows.actions.tolist()
    for episode, agent, action in zip(rows.episodes.tolist(), rows.agents.tolist(), actions, strict=True):
        yield episode, connection.agents[agent], action


def _document(episode: int, report: Report) -> dict[str, Any]:
    flags = {name: True for name in ("terminated", "truncated") if getattr(report, name)}
    observation = encode(report.observation, "base64")
    return {"episode": episode, "agent": report.agent, "observation": observation, "reward": report.reward, **flags}


def _at(value: Any, path: Sequence[str]) -> Any:
    for key in path:
        value = value[key]
    return value


def _raise_if_permanent(error: Exception) -> None:
    """Raise the LeagueError of a failure that would occur again."""
    if isinstance(error, InvalidStatus):
        response = httpx.Response(error.response.status_code, content=bytes(error.response.body or b""))
        if retry_deadline(response) < NOT_READY_DEADLINE:
            raise parse_error(response, "the server") from error
    if isinstance(error, ConnectionClosed) and error.rcvd is not None and error.rcvd.code in PERMANENT_CLOSE_CODES:
        raise PERMANENT_CLOSE_CODES[error.rcvd.code](error.rcvd.reason or one_line(error)) from error


class PettingZooGame:
    """A PettingZoo environment, AEC or Parallel, as a game: what `simulate` plays is the environment in Python."""

    def __init__(self, env: Any) -> None:
        """env: an AECEnv or a ParallelEnv."""
        self._env = env
        self._is_parallel = not hasattr(env, "agent_iter")

    def reset(self, seed: int) -> list[Report]:
        """See SimulatedGame."""
        if self._is_parallel:
            observations, _ = self._env.reset(seed=seed)
            return [Report(agent, observations[agent]) for agent in self._env.agents]
        self._env.reset(seed=seed)
        return self._until_action()

    def step(self, actions: Mapping[str, Any]) -> list[Report]:
        """See SimulatedGame."""
        if self._is_parallel:
            observations, rewards, terminations, truncations, _ = self._env.step(dict(actions))
            return [
                Report(agent, observations[agent], float(rewards[agent]), terminations[agent], truncations[agent])
                for agent in observations
            ]
        self._env.step(actions[self._env.agent_selection])
        return self._until_action()

    def _until_action(self) -> list[Report]:
        reports = []
        while self._env.agents:
            agent = self._env.agent_selection
            observation, reward, terminated, truncated, _ = self._env.last()
            reports.append(Report(agent, _copied(observation), float(reward), bool(terminated), bool(truncated)))
            if not (terminated or truncated):
                break
            self._env.step(None)
        return reports


def _copied(observation: Any) -> Any:
    if isinstance(observation, Mapping):
        return {key: _copied(part) for key, part in observation.items()}
    return np.array(observation)
