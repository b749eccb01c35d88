"""Messages between a gateway and a simulator: decoded and checked, and encoded.

All bytes are a simulator's: sizes are checked before memory is allocated, and everything before it is used. The
client's side is `policy_league_client.simulator`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from league.environments.stepping import Indices
from league.environments.vector.vector_env import AgentRows
from league.errors import InvalidInput, InvalidReward, LeagueError, ObservationError
from league.interface import AgentInterface
from league.spaces import ACTION_MASK, DictSpace
from league.spaces.arrays import check, check_mask
from league.spaces.binary_leaves import little_endian
from league.spaces.observation_codec import ObservationReader, json_type
from policy_league_client.simulator import (
    ACTIONS,
    COLUMNS,
    HEADER,
    OVER,
    PROTOCOL,
    REPORTS,
    TERMINATED,
    TRUNCATED,
)

MAX_MESSAGE = 16 * 2**20
"""Bytes of a message."""
MAX_ROWS = 65_536
"""Reports in a message."""
MAX_EPISODES = 4096
"""Episodes that a connection may play at the same time."""
MAX_EPISODE = 2**32 - 1
KEYS = frozenset(("episode", "agent", "observation", "reward", "terminated", "truncated"))


@dataclass(frozen=True, slots=True)
class Reports:
    """A message with reports, and the episodes that are over with them."""

    rows: list[AgentRows]
    """Of agents with equal spaces each, in the order of the message. Their `envs` are episodes."""
    over: list[int]

    @property
    def nbytes(self) -> int:
        """The size of the observations in memory."""
        return sum(array.nbytes for part in self.rows for array in part.observations.values())


@dataclass(frozen=True, slots=True)
class Abandoned:
    """A message with which a simulator gives up episodes."""

    episodes: list[int]
    nbytes: int = 0


@dataclass(frozen=True, slots=True)
class Hello:
    """The first message of a simulator."""

    name: str
    version: str
    episodes: int
    binary: bool


class SpaceLayout:
    """Agents with equal spaces.

    Attributes:
        agents: Their indices.
        action: The space of their actions.
        row_bytes: Bytes of a report.
    """

    def __init__(self, agents: Sequence[int], spaces: AgentInterface) -> None:
        assert not isinstance(spaces.action, DictSpace), "action spaces are not dictionaries"
        self.agents, self.action = tuple(agents), spaces.action
        self.reader = ObservationReader(spaces.observation)
        leaves = [(name, np.dtype(leaf.dtype).newbyteorder("<"), leaf.shape) for name, _, leaf in self.reader.leaves]
        columns = [*(("a report", dtype, ()) for dtype in COLUMNS), *leaves]
        self._columns = [(name, dtype, shape, dtype.itemsize * prod(shape)) for name, dtype, shape in columns]
        self.row_bytes = sum(row_bytes for *_, row_bytes in self._columns)

    def columns(self, message: memoryview, rows: int) -> list[NDArray]:
        """Return the columns of a block of a binary message. Raises ObservationError for bytes that are no booleans."""
        arrays, at = [], 0
        for name, dtype, shape, row_bytes in self._columns:
            end = at + rows * row_bytes
            arrays.append(little_endian(name, message[at:end], dtype).reshape(rows, *shape))
            at = end
        return arrays

    def document(self, names: Sequence[str]) -> dict[str, Any]:
        """Return the layout as a simulator gets it."""
        return {
            "agents": [names[agent] for agent in self.agents],
            "inputs": [
                {"name": name, "path": path, "dtype": leaf.dtype, "shape": leaf.shape}
                for name, path, leaf in self.reader.leaves
            ],
            "action": {"dtype": self.action.dtype, "shape": self.action.shape},
        }


class MessageCodec:
    """Decodes and encodes the messages of one game.

    Attributes:
        layouts: The layouts.
        layout_of: Agent → number of its layout.
    """

    def __init__(self, agents: Mapping[str, AgentInterface]) -> None:
        self._names = tuple(agents)
        self._index = {name: index for index, name in enumerate(agents)}
        members: dict[str, list[int]] = {}
        for index, spaces in enumerate(agents.values()):
            members.setdefault(spaces.model_dump_json(), []).append(index)
        self.layouts = [SpaceLayout(indices, agents[self._names[indices[0]]]) for indices in members.values()]
        numbers = {agent: number for number, layout in enumerate(self.layouts) for agent in layout.agents}
        self.layout_of = [numbers[agent] for agent in range(len(agents))]

    def hello(self, message: str | bytes) -> Hello:
        """Read the first message. Raises InvalidInput."""
        document = _object(message)
        if document.get("type") != "hello":
            raise InvalidInput(f"the first message has the type {_shown(document.get('type'))}, expected 'hello'")
        if document.get("protocol") != PROTOCOL:
            raise InvalidInput(f"protocol is {_shown(document.get('protocol'))}, expected {PROTOCOL}")
        match document:
            case {"simulator": {"name": str(name), "version": str(version)}}:
                episodes = _integer("episodes", document.get("episodes", 1), 1, MAX_EPISODES)
                return Hello(name, version, episodes, document.get("binary") is True)
        raise InvalidInput("simulator must be an object with name and version, two strings")

    def welcome(self, league: str) -> bytes:
        """Return the response to `hello`."""
        layouts = [layout.document(self._names) for layout in self.layouts]
        return orjson.dumps(
            {"type": "welcome", "protocol": PROTOCOL, "league": league, "agents": self._names, "layouts": layouts}
        )

    def read(self, message: str | bytes, episodes: int = MAX_EPISODES) -> Reports | Abandoned:
        """Read any later message. episodes: how many the simulator plays. Raises InvalidInput."""
        most = min(episodes * len(self._names), MAX_ROWS)
        if isinstance(message, bytes):
            return self._binary(message, most)
        document = _object(message)
        match document.get("type"):
            case "reports":
                return self._reports(document, most)
            case "abandon":
                return Abandoned(_episodes("episodes", document.get("episodes")))
            case other:
                raise InvalidInput(f"a message has the type {_shown(other)}, expected 'reports' or 'abandon'")

    def actions(self, layout: int, episodes: Indices, agents: Indices, actions: NDArray, binary: bool) -> bytes | str:
        """Return the message with the actions, (k, …), of agents with equal spaces."""
        space = self.layouts[layout].action
        actions = actions.astype(np.dtype(space.dtype).newbyteorder("<"), copy=False)
        if not binary:
            rows = [
                {"episode": episode, "agent": self._names[agent], "action": action}
                for episode, agent, action in zip(episodes.tolist(), agents.tolist(), actions.tolist(), strict=True)
            ]
            return orjson.dumps({"type": "actions", "actions": rows}).decode()
        head = HEADER.pack(PROTOCOL, ACTIONS, layout, len(episodes))
        return b"".join((head, episodes.astype("<u4").tobytes(), agents.astype("<u2").tobytes(), actions.tobytes()))

    def _binary(self, message: bytes, most: int) -> Reports:
        reports, at = Reports([], []), 0
        while at < len(message) or not at:
            if len(message) - at < HEADER.size:
                raise InvalidInput(f"a message has {len(message) - at} bytes, expected a header of {HEADER.size}")
            protocol, kind, number, rows = HEADER.unpack_from(message, at)
            if protocol != PROTOCOL or kind != REPORTS:
                start = message[at : at + 2].hex(" ")
                raise InvalidInput(f"a block of a message starts with {start}, expected {PROTOCOL:02x} {REPORTS:02x}")
            if number >= len(self.layouts):
                raise InvalidInput(f"the layout is {number}, expected one below {len(self.layouts)}")
            _integer("the number of rows", rows, 1, most)
            at += HEADER.size
            size = rows * self.layouts[number].row_bytes
            if len(message) - at < size:
                parts = ", ".join(
                    f"{name} {leaf.dtype} {list(leaf.shape)}" for name, _, leaf in self.layouts[number].reader.leaves
                )
                raise ObservationError(f"{rows} reports have {len(message) - at} bytes, expected {size}: {parts}")
            self._read_block(memoryview(message)[at:], number, rows, reports)
            at += size
        return reports

    def _read_block(self, message: memoryview, number: int, rows: int, reports: Reports) -> None:
        """Add the reports of agents with equal spaces."""
        layout = self.layouts[number]
        rewards, episodes, agents, flags, *inputs = layout.columns(message, rows)
        if foreign := set(agents.tolist()).difference(layout.agents):
            raise InvalidInput(f"agent {min(foreign)} is not one of layout {number}: {list(layout.agents)}")
        if (flags & ~np.uint8(TERMINATED | TRUNCATED | OVER)).any():
            raise InvalidInput(f"a report has the flags {int(flags.max())}, expected at most 7")
        if not np.isfinite(rewards).all():
            raise InvalidReward(f"a reward is {rewards[~np.isfinite(rewards)][0]}, expected a finite number")
        leaves = layout.reader.leaves
        observations = {name: check(name, array, leaf) for (name, _, leaf), array in zip(leaves, inputs, strict=True)}
        if (mask := observations.get(ACTION_MASK)) is not None:
            check_mask(mask[(flags & (TERMINATED | TRUNCATED)) == 0])
        terminated, truncated = ((flags & flag) != 0 for flag in (TERMINATED, TRUNCATED))
        columns = episodes.astype(np.int64), agents.astype(np.int64), observations, rewards.astype(np.float64)
        reports.rows.append(AgentRows(*columns, terminated, truncated))
        reports.over.extend(episodes[(flags & OVER) != 0].tolist())

    def _reports(self, document: dict[str, Any], most: int) -> Reports:
        reports = document.get("reports")
        if not isinstance(reports, list) or len(reports) > most:
            raise InvalidInput(f"reports must be a list of at most {most} objects")
        parts: dict[tuple[int, bool], list[tuple[int, int, Any, float, bool, bool]]] = {}
        for report in reports:
            row = self._report(report)
            parts.setdefault((self.layout_of[row[1]], row[4] or row[5]), []).append(row)
        rows = []
        for (number, is_last), part in parts.items():
            episodes, agents, observations, rewards, terminated, truncated = zip(*part, strict=True)
            agent_rows = AgentRows(
                np.array(episodes, np.int64),
                np.array(agents, np.int64),
                self.layouts[number].reader.read(observations, is_last=is_last),
                np.array(rewards, np.float64),  # finite, as all numbers of JSON
                np.array(terminated, bool),
                np.array(truncated, bool),
            )
            rows.append(agent_rows)
        return Reports(rows, _episodes("over", document.get("over", [])))

    def _report(self, report: Any) -> tuple[int, int, Any, float, bool, bool]:
        if type(report) is not dict:
            raise InvalidInput(f"a report is {json_type(report)}, expected an object")
        if unknown := report.keys() - KEYS:
            raise InvalidInput(
                f"a report has the unknown key {min(unknown)[:64]!r}, expected {', '.join(sorted(KEYS))}"
            )
        agent = report.get("agent")
        if not isinstance(agent, str) or agent not in self._index:
            names = ", ".join(self._names[:8]) + (" …" if len(self._names) > 8 else "")
            raise InvalidInput(f"{_shown(agent)} is no agent of this game, expected one of {names}")
        if "observation" not in report:
            raise InvalidInput(f"a report of {agent} lacks the key observation")
        reward = report.get("reward", 0.0)
        if type(reward) not in (int, float):
            raise InvalidInput(f"the reward of {agent} is {json_type(reward)}, expected a number")
        flags = [report.get(name, False) for name in ("terminated", "truncated")]
        if not all(type(flag) is bool for flag in flags):
            raise InvalidInput(f"terminated and truncated of {agent} must be booleans")
        episode = _integer("episode", report.get("episode"), 0, MAX_EPISODE)
        return episode, self._index[agent], report["observation"], float(reward), *flags


def play(episodes: Sequence[int], seeds: Sequence[int]) -> str:
    """Return the message that starts episodes."""
    starts = [{"episode": episode, "seed": seed} for episode, seed in zip(episodes, seeds, strict=True)]
    return orjson.dumps({"type": "play", "episodes": starts}).decode()


def abandon(episodes: Sequence[int]) -> str:
    """Return the message that ends episodes for which nobody waits."""
    return orjson.dumps({"type": "abandon", "episodes": list(episodes)}).decode()


def refusal(error: LeagueError) -> str:
    """Return the last message before a connection is closed."""
    return orjson.dumps({"type": "error", "code": error.code, "message": str(error)}).decode()


def _shown(value: Any) -> str:
    """Return a value for an error message. Others than numbers and strings may be nested deeply."""
    return f"{value!r:.64}" if isinstance(value, str | int | float | None) else json_type(value)


def _object(message: str | bytes) -> dict[str, Any]:
    try:
        document = orjson.loads(message)
    except orjson.JSONDecodeError as error:
        raise InvalidInput(f"a message is no JSON: {str(error)[:100]}") from error
    if type(document) is not dict:
        raise InvalidInput(f"a message is {json_type(document)}, expected an object with a type")
    return document


def _integer(name: str, value: Any, least: int, most: int) -> int:
    if type(value) is not int or not least <= value <= most:
        raise InvalidInput(f"{name} is {_shown(value)}, expected an integer from {least} to {most}")
    return value


def _episodes(name: str, value: Any) -> list[int]:
    if not isinstance(value, list) or len(value) > MAX_ROWS:
        raise InvalidInput(f"{name} must be a list of at most {MAX_ROWS} episodes")
    return [_integer(name, episode, 0, MAX_EPISODE) for episode in value]
