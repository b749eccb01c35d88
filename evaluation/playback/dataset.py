"""Writes the recorded games of a league as Parquet: one file per policy, one row per decision."""

from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import ExitStack, closing
from dataclasses import dataclass
from itertools import chain
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import orjson

from evaluation.matches.seating import agent_sides
from evaluation.playback.replay import replay, seated
from evaluation.playback.single_game import GameStep
from league.environments.implementation import stock_stepping
from league.errors import ConfigError, NotFound
from league.interface import AgentInterface, Interface
from league.policies.loading import pinned
from league.registry.registry import Registry
from league.registry.storage.exports import new_folder
from league.results.ledger import Ledger
from league.results.records import Match, Schedule
from league.spaces import DictSpace, inputs

ROWS_OF_GROUP = 16_384
"""Rows of a row group, which are held in memory for each policy."""


@dataclass(slots=True)
class _Decision:
    """A row, without its reward until the agent decides again or leaves."""

    policy: str
    row: dict[str, Any]
    before: float
    """The agent's return before the action."""


def write_games(
    registry: Registry,
    league: str,
    directory: Path,
    players: Collection[str] = (),
    limit: int | None = None,
    on_game: Callable[[int], None] = lambda _: None,
) -> dict[str, int]:
    """Replay the games of a league that count under its current rules, and write what was observed and decided.

    Args:
        registry: Where the league is registered.
        league: Its name.
        directory: Must not exist, or be empty. It gets a file `POLICY.parquet` for each policy, or nothing at all.
        players: Write only decisions of these contestants, such as `connect_four@3`; empty for all. The decisions of a
            mixture are those of its members.
        limit: Number of games to write, of those in which they played; None for all.
        on_game: Called after each game with the number of games so far.

    Returns:
        Name of the policy → rows of its file.

    Raises:
        NotFound: There is no such league, version or game.
        EnvironmentMismatch: The environment deviates from the record.
        ConfigError: pyarrow is not installed, or `directory` is not empty.
    """
    try:
        import pyarrow.parquet as pq
    except ModuleNotFoundError:
        raise ConfigError("writing Parquet needs pyarrow: pip install pyarrow") from None
    league_row = registry.leagues.get(league)
    interface, ledger = league_row.interface, Ledger(registry)
    policies = {name: interface.agents[agent] for agent, name in interface.policies.items()}
    refs = {pinned(ref, league, registry) for ref in players}
    pending: dict[str, list[dict[str, Any]]] = {name: [] for name in policies}
    counts, games = dict.fromkeys(policies, 0), 0
    with new_folder(directory) as draft, ExitStack() as stack:
        writers = {
            name: stack.enter_context(pq.ParquetWriter(draft / f"{name}.parquet", _schema(league, name, spaces)))
            for name, spaces in policies.items()
        }

        def write(name: str) -> None:
            rows, pending[name] = pending[name], []
            counts[name] += len(rows)
            writers[name].write_table(_table(rows, policies[name], writers[name].schema))

        environment = stack.enter_context(closing(stock_stepping(league_row.config.environment, num_envs=1)))
        for match, game in _games(ledger, ledger.counted(league, league_row.conditions)):
            if games == limit:
                break
            if refs and refs.isdisjoint(match.acting(game)):
                continue
            steps = replay(environment, league_row.config, interface, match, game)
            for decision in _decisions(steps, match, game, interface):
                if not refs or decision.row["player"] in refs:
                    pending[decision.policy].append(decision.row)
                    if len(pending[decision.policy]) == ROWS_OF_GROUP:
                        write(decision.policy)
            games += 1
            on_game(games)
        if not games:
            of_players = f" of {', '.join(sorted(refs))}" if refs else ""
            raise NotFound(
                f"{league} has no games{of_players} under its current rules: `league evaluate {league}` plays some"
            )
        for name in policies:
            write(name)
    return counts


def _games(ledger: Ledger, schedules: list[Schedule]) -> Iterator[tuple[Match, int]]:
    matches = chain.from_iterable(map(ledger.walk, schedules))
    return ((match, game) for match in matches for game in range(len(match.games)))


def _decisions(steps: Iterator[GameStep], match: Match, game: int, interface: Interface) -> Iterator[_Decision]:
    """The decisions of a game, each once its reward is complete."""
    agents, acting, record = list(interface.agents), match.acting(game), match.games[game]
    sides = zip(agents, agent_sides(agents, seated(interface, record)), strict=True)
    players = {agent: acting[record.sides[side]] for agent, side in sides}
    opening, returns = len(record.opening), dict.fromkeys(agents, 0.0)
    last: dict[str, _Decision] = {}
    for step in steps:
        for move in step.moves:
            if move.agent in last:
                yield _rewarded(last.pop(move.agent), returns)
            row = {
                "match": match.id,
                "game": game,
                "step": step.step - 1,
                "agent": move.agent,
                "player": players[move.agent],
                "is_opening": opening > 0,
                **move.observation,
                "action": move.action,
                "terminated": False,
                "truncated": False,
            }
            opening -= 1
            last[move.agent] = _Decision(interface.policies[move.agent], row, returns[move.agent])
        returns = step.returns
        for ending in step.endings:
            if (decision := last.pop(agents[ending.agent], None)) is not None:
                decision.row |= {"terminated": ending.terminated, "truncated": ending.truncated}
                yield _rewarded(decision, returns)
    for decision in last.values():  # the game was forfeited
        decision.row["truncated"] = True
        yield _rewarded(decision, returns)


def _rewarded(decision: _Decision, returns: Mapping[str, float]) -> _Decision:
    decision.row["reward"] = returns[decision.row["agent"]] - decision.before
    return decision


def _arrays(spaces: AgentInterface) -> dict[str, tuple[tuple[int, ...], str]]:
    """Column → shape and dtype of what is observed and of the action."""
    assert not isinstance(spaces.action, DictSpace), "action spaces are not dictionaries"
    leaves = {name: (leaf.shape, leaf.dtype) for name, leaf in inputs(spaces.observation).items()}
    return leaves | {"action": (spaces.action.shape, spaces.action.dtype)}


def _schema(league: str, policy: str, spaces: AgentInterface) -> Any:
    """The columns. Arrays are flat, in row-major order; the metadata has their shapes, and the space of actions."""
    import pyarrow as pa

    def type_of(shape: tuple[int, ...], dtype: str) -> Any:
        scalar = pa.from_numpy_dtype(np.dtype(dtype))
        return pa.list_(scalar, prod(shape)) if shape else scalar

    arrays = _arrays(spaces)
    fields = [
        ("match", pa.string()),
        ("game", pa.int32()),
        ("step", pa.int32()),
        ("agent", pa.string()),
        ("player", pa.string()),
        ("is_opening", pa.bool_()),
        *((name, type_of(*array)) for name, array in arrays.items()),
        ("reward", pa.float64()),
        ("terminated", pa.bool_()),
        ("truncated", pa.bool_()),
    ]
    document = {
        "league": league,
        "policy": policy,
        "shapes": {name: shape for name, (shape, _) in arrays.items()},
        "action": spaces.action.model_dump(mode="json"),
    }
    return pa.schema(fields, metadata={"policy_league": orjson.dumps(document)})


def _table(rows: list[dict[str, Any]], spaces: AgentInterface, schema: Any) -> Any:
    import pyarrow as pa

    arrays, columns = _arrays(spaces), []
    for field in schema:
        values = [row[field.name] for row in rows]
        if field.name in arrays:
            shape, dtype = arrays[field.name]
            flat = pa.array(np.asarray(values, dtype).reshape(-1))
            columns.append(pa.FixedSizeListArray.from_arrays(flat, prod(shape)) if shape else flat)
        else:
            columns.append(pa.array(values, field.type))
    return pa.table(columns, schema)
