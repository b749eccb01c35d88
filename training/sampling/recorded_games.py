"""Recorded games in place of played ones: files `POLICY.parquet` as `league export-games` writes them."""

from collections.abc import Iterator
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from league.config.marwil import MARWILConfig
from league.environments.stepping import Indices
from league.errors import ConfigError, ObservationError
from league.interface import AgentInterface, Interface
from league.policies.actions import dist_inputs_size, from_environment
from league.random.seeds import generator
from league.spaces import ACTION_MASK, Box, DictSpace, Discrete, MultiDiscrete, inputs
from league.spaces.arrays import check
from training.sampling.env_runner import BatchedEnvRunner
from training.sampling.episode_chunks import EpisodeChunks, acted_rows

KEY = "training.data"
PLACE = ("match", "game", "agent", "step")
"""Columns that say which decision a row is. Rows may be in any order."""
OUTCOME = ("action", "reward", "terminated")
IS_OPENING = "is_opening"
"""Optional column of random moves, which are not learned."""
REWARD = Box(dtype="float32", shape=(), low=None, high=None)
FLAG = Discrete(n=2, dtype="int8")


def files(directory: Path, interface: Interface) -> dict[str, Path]:
    """Return policy id → its file. Raises ConfigError unless each exists and has all columns."""
    paths = {policy: directory / f"{policy}.parquet" for policy in interface.policy_ids}
    for policy, path in paths.items():
        try:
            names = pq.read_schema(path).names
        except FileNotFoundError:
            raise ConfigError(
                f"{KEY}: {path} does not exist: expected a file for each policy, as `league export-games` writes them"
            ) from None
        except (OSError, pa.ArrowInvalid) as error:
            raise ConfigError(f"{KEY}: {path} cannot be read as Parquet: {error}") from error
        for column in (*PLACE, *inputs(interface.of_policy(policy).observation), *OUTCOME):
            if column not in names:
                raise ConfigError(f"{KEY}: {path} has no column {column!r}, only {', '.join(names)}")
    return paths


@dataclass(frozen=True, slots=True)
class RecordedGames:
    """Decisions of a policy, of one agent in one game after the other.

    Attributes:
        policy: Policy id.
        outputs: Inputs of the policy's action distribution.
        observations: ONNX input name → (n, …).
        actions: Raw, (n,) or (n, m).
        rewards: (n,) float32.
        firsts: The first row of each agent in each game, (c,).
        lengths: Decisions of each, from which it learns, (c,), at least 1.
        terminated: Whether each terminated after its last decision, (c,) bool. Of any other agent, the row after those
            that count is observed only, because what it observed in the end is not recorded.
    """

    policy: str
    outputs: int
    observations: dict[str, NDArray]
    actions: NDArray
    rewards: NDArray[np.float32]
    firsts: Indices
    lengths: Indices
    terminated: NDArray[np.bool_]

    @classmethod
    def read(cls, path: Path, policy: str, spaces: AgentInterface) -> "RecordedGames":
        """Read a file; see `files`.

        Raises ConfigError for another type or size than that of the space, an illegal action, or no decisions.
        """
        table = pq.read_table(path)
        if IS_OPENING in table.column_names:
            table = table.filter(pc.invert(table[IS_OPENING]))
        table = table.sort_by([(name, "ascending") for name in PLACE])
        assert not isinstance(spaces.action, DictSpace), "action spaces are not dictionaries"
        leaves = inputs(spaces.observation) | {"action": spaces.action, "reward": REWARD, "terminated": FLAG}
        try:
            columns = {name: check(name, _array(name, table[name], leaf.shape), leaf) for name, leaf in leaves.items()}
            action, rewards, ends = (columns.pop(name) for name in OUTCOME)
            raw = from_environment(action, spaces.action)
            if ACTION_MASK in columns and isinstance(spaces.action, Discrete | MultiDiscrete):
                _check_legal(raw, columns[ACTION_MASK], spaces.action)
        except (ObservationError, pa.ArrowInvalid) as error:
            raise ConfigError(f"{KEY}: {path}: {error}") from error
        is_first = np.ones(len(table), bool)
        is_first[1:] = np.any([_differs(table[name]) for name in PLACE[:-1]], axis=0)
        firsts = np.flatnonzero(is_first)
        lengths = np.diff(np.append(firsts, len(table)))
        terminated = ends[firsts + lengths - 1].astype(bool)
        lengths = lengths - ~terminated
        kept = lengths > 0
        if not kept.any():
            raise ConfigError(f"{KEY}: {path} has no decisions to learn from")
        size = dist_inputs_size(spaces.action)
        return cls(policy, size, columns, raw, rewards, firsts[kept], lengths[kept], terminated[kept])

    def chunks(self, name: str, numbers: Indices) -> EpisodeChunks:
        """Return the decisions of some agents in some games, given by their indices.

        Log-probabilities and distribution inputs are 0: they were not recorded.
        """
        lengths, terminated = self.lengths[numbers], self.terminated[numbers]
        stops = np.cumsum(lengths + 1)
        # One observation more than decisions. That after a termination is not recorded, and does not count.
        rows = np.arange(stops[-1]) + np.repeat(self.firsts[numbers] - (stops - lengths - 1), lengths + 1)
        rows[stops - 1] -= terminated
        decisions = rows[acted_rows(lengths)]
        zeros = np.zeros(len(numbers), np.int64)
        return EpisodeChunks(
            name=name,
            policy=self.policy,
            agents=zeros,
            started=zeros,
            lengths=lengths,
            observations={column: values[rows] for column, values in self.observations.items()},
            actions=self.actions[decisions],
            log_p=np.zeros(len(decisions), np.float32),
            dist_inputs=np.zeros((len(decisions), self.outputs), np.float32),
            state={},
            rewards=self.rewards[decisions],
            terminated=terminated,
            truncated=~terminated,
        )


def _array(name: str, column: pa.ChunkedArray, shape: tuple[int, ...]) -> NDArray:
    """Return a column of numbers or of lists of numbers, (k, *shape). Raises ObservationError for another size."""
    if column.null_count:
        raise ObservationError(f"{name} has {column.null_count} values that are null")
    if pa.types.is_boolean(column.type):
        column = column.cast(pa.int8())
    values = column.combine_chunks()
    while pa.types.is_list(values.type) or pa.types.is_fixed_size_list(values.type):
        values = values.flatten()
    array = values.to_numpy(zero_copy_only=False)
    if array.size != len(column) * prod(shape):
        raise ObservationError(f"{name} has {array.size} numbers in {len(column)} rows, expected {prod(shape)} in each")
    return array.reshape(-1, *shape)


def _check_legal(raw: NDArray, mask: NDArray, action: Discrete | MultiDiscrete) -> None:
    """Raise ObservationError for an action that the mask, (k, options), does not allow."""
    options = np.array([action.n] if isinstance(action, Discrete) else action.nvec).reshape(-1)
    columns = raw.reshape(len(raw), -1) + np.cumsum(options) - options
    legal = np.take_along_axis(mask.reshape(len(mask), -1), columns, axis=1) != 0
    if not legal.all():
        raise ObservationError(f"{np.count_nonzero(~legal.all(axis=1))} actions are not legal by their action_mask")


def _differs(column: pa.ChunkedArray) -> NDArray[np.bool_]:
    """Return whether each value but the first differs from the one before, (k - 1,)."""
    codes = column.combine_chunks().dictionary_encode().indices.to_numpy(zero_copy_only=False)
    return np.diff(codes) != 0


class RecordedRunner(BatchedEnvRunner):
    """A runner that returns recorded decisions instead of playing.

    Each runner has its part of the games. It goes through them in a random order, which depends on the run's seed and
    on its number of steps when the episodes were reset.
    """

    _samples_drawn = 0

    def make_env(self) -> None:
        """Read the games. The environment exists for its agents only."""
        super().make_env()
        settings = self.league.training
        assert isinstance(settings, MARWILConfig)
        self._games = {
            policy: RecordedGames.read(path, policy, self.interface.of_policy(policy))
            for policy, path in files(Path(settings.data), self.interface).items()
        }

    def reset_episodes(self, steps: int) -> None:
        """See BatchedEnvRunner."""
        super().reset_episodes(steps)
        self._order = self._draw(steps)

    def sample_chunks(self, **_: Any) -> list[EpisodeChunks]:
        """Return whole recorded games, with at least the configured number of decisions in total."""
        assert self._play is not None, "a runner that only holds weights cannot sample"
        if not self._has_begun:
            self.reset_episodes(self.num_env_steps_sampled_lifetime)
        missing = self.config.get_rollout_fragment_length(self.worker_index) * self.config.num_envs_per_env_runner
        drawn: dict[str, list[int]] = {policy: [] for policy in self._games}
        while missing > 0:
            policy, number = next(self._order)
            drawn[policy].append(number)
            missing -= self._games[policy].lengths[number]
        self._samples_drawn += 1
        name = f"{self.worker_index}-{self._samples_drawn}"
        chunks = [self._games[policy].chunks(name, np.array(numbers)) for policy, numbers in drawn.items() if numbers]
        self._play.metrics.add_moves(sum(int(part.lengths.sum()) for part in chunks))
        return chunks

    def _draw(self, steps: int) -> Iterator[tuple[str, int]]:
        """Yield policies and indices of their games, of each the same number of times."""
        seed, runner, runners = (
            self.config.seed or 0,
            max(self.worker_index - 1, 0),
            max(self.config.num_env_runners, 1),
        )
        games = [
            (policy, number) for policy, recorded in self._games.items() for number in range(len(recorded.lengths))
        ]
        part = games[runner::runners] or games
        rng = generator(seed, "recorded", runner, steps)
        while True:
            for index in rng.permutation(len(part)):
                yield part[index]
