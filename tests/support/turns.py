"""Turns of batched environments of each kind: their cases are recorded in `tests/data/turns.json.xz`.

A turn is recorded with a number for each observation, which changes with every one of its values. Processors differ in
the last digits of floats. The turns of simulators depend on when they answer: their episodes are recorded.
"""

import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from league.config.environment import EnvironmentConfig
from league.environments.building import agent_interface, build
from league.environments.implementation import implementation, stepping, stock_stepping
from league.environments.stepping import Batch, BatchedEnvironment, States, Turn
from league.environments.vector.vector_env import AgentRows
from league.errors import LeagueError
from tests.conformance.stepping import lockstep
from tests.support import simulators
from tests.support.environments import faulty_steps, masked, vector_copies
from tests.support.environments.kinds import KINDS
from tests.support.environments.player import Player
from tests.support.leagues import tictactoe

STEPS, NUM_ENVS = 24, 4
Make = Callable[..., BatchedEnvironment]
CLASSIC, BUTTERFLY, EXAMPLES = "pettingzoo.classic.", "pettingzoo.butterfly.", "policy_league.examples."
SUPPORT, COPIES = "tests.support.environments.", vector_copies.__name__
MEETING, COUNTING = f"{SUPPORT}simultaneous:meeting", f"{SUPPORT}counting:counting"
JOINING = {"arrives": [0, 2, 1, 0], "leaves": [4, 5, 2, 3], "truncated": [1, 2]}
INTERRUPTED = "interrupted"
TURNS: dict[str, dict[str, Any]] = {
    "connect four": {"entry_point": f"{CLASSIC}connect_four_v3"},
    "tic-tac-toe": {"entry_point": f"{CLASSIC}tictactoe_v3"},
    "Leduc hold'em": {"entry_point": f"{CLASSIC}leduc_holdem_v4"},
    "rock, paper, scissors": {"entry_point": f"{CLASSIC}rps_v2", "kwargs": {"max_cycles": 4}},
    "spread": {"entry_point": "mpe2.simple_spread_v3", "kwargs": {"max_cycles": 5}},
    "adversary": {"entry_point": "mpe2.simple_adversary_v3", "kwargs": {"max_cycles": 5}},
    "tag, padded and stacked": {
        "entry_point": "mpe2.simple_tag_v3",
        "kwargs": {"max_cycles": 5, "num_adversaries": 2},
        "wrappers": ["pad_observations_v0", {"frame_stack_v1": {"stack_size": 2}}],
    },
    "Kuhn poker": {
        "entry_point": f"{EXAMPLES}kuhn_poker:env",
        "vector": f"{EXAMPLES}kuhn_poker_vector:KuhnPokerVector",
    },
    "joining and leaving": {"entry_point": MEETING, "kwargs": JOINING, "vector": f"{COPIES}:VectorMeeting"},
    "early deaths": {
        "entry_point": COUNTING,
        "kwargs": {"lives": [1, 4, 2, 4], "truncated": [1, 2]},
        "vector": f"{COPIES}:VectorCounting",
    },
    "wrong reward": {
        "entry_point": MEETING,
        "kwargs": {"bad_reward": float("inf"), "arrives": [2, 0]},
        "vector": f"{COPIES}:VectorMeeting",
    },
    INTERRUPTED: {
        "entry_point": f"{SUPPORT}faulty_steps:hanging",
        "kwargs": {"hangs": [9, 10, 11]},
        "vector": f"{SUPPORT}faulty_steps:VectorHanging",
    },
}
"""Environments with a vectorised implementation, with which the stock environments share the recorded turns."""
STOCK: dict[str, dict[str, Any]] = {
    "one crash in each of some episodes": {"entry_point": MEETING, "kwargs": {"crashes": [1, 4, 5, 11, 20]}},
    "too many crashes": {"entry_point": MEETING, "kwargs": {"crashes": list(range(5, 99))}},
    "continuous actions": {
        "entry_point": "mpe2.simple_world_comm_v3",
        "kwargs": {"max_cycles": 5, "continuous_actions": True},
    },
    "knights, archers, zombies": {
        "entry_point": f"{BUTTERFLY}knights_archers_zombies_v11",
        "kwargs": {"max_cycles": 8, "spawn_delay": 2},
    },
    "no-limit hold'em": {"entry_point": f"{CLASSIC}texas_holdem_no_limit_v6", "kwargs": {"num_players": 3}},
    "RLlib": {"entry_point": f"{SUPPORT}simultaneous:rllib_meeting", "kwargs": {"ends": 4}},
    "RLlib, silent end": {"entry_point": f"{SUPPORT}simultaneous:rllib_meeting", "kwargs": {"silent": True}},
    "cars and lights": {"entry_point": f"{EXAMPLES}traffic:crossing"},
    "two-step game": {"entry_point": f"{EXAMPLES}two_step:parallel_env"},
    "OpenSpiel": {"entry_point": "openspiel", "kwargs": {"game": "liars_dice", "information_state": True}},
    "pistons through SuperSuit": {
        "entry_point": f"{BUTTERFLY}pistonball_v6",
        "kwargs": {"n_pistons": 3, "max_cycles": 4},
        "wrappers": [
            {"color_reduction_v0": {"mode": "R"}},
            {"resize_v1": {"x_size": 12, "y_size": 48}},
            {"frame_stack_v1": {"stack_size": 2}},
        ],
    },
} | {
    f"{api}, mask {space}": {"entry_point": f"{masked.__name__}:{api}", "kwargs": {"space": space}}
    for api in masked.APIS
    for space in ("obs", "nested", "secret", "multi")
}
FAULTS = ("empty", "mute", "flown", "stranger", "misshapen", "exits")


def documents() -> Iterator[tuple[str, Any]]:
    """Yield each case, and what was recorded."""
    for name in (*TURNS, *STOCK, *FAULTS):
        yield name, turns(name, stock_stepping)
    yield f"{INTERRUPTED}, vectorised", turns(INTERRUPTED, stepping)
    yield "fast seeds", turns("Leduc hold'em", stepping, fast_seeds=True)
    yield from external().items()


def configuration(name: str) -> EnvironmentConfig:
    if name in FAULTS:
        return EnvironmentConfig(entry_point=f"{SUPPORT}faulty_steps:violation", kwargs={"fault": name})
    return EnvironmentConfig.model_validate((TURNS | STOCK)[name])


def turns(name: str, make: Make, **options: Any) -> list[Any]:
    """All that a player learns of an environment. The last document is that of an exception, if there is one."""
    config = configuration(name)
    assert make is stock_stepping or implementation(config).vector is not None
    with closing(build(config)) as env:
        actions = [agent_interface(env, agent).action for agent in env.possible_agents]
    faulty_steps.CLOSED.clear()
    documents: list[Any] = []
    with closing(make(config, NUM_ENVS, crashes=2, states=True, **options)) as batched:
        player = Player(batched, len(name), actions)
        try:
            documents.append(_turn(player.start()))
            for _ in range(STEPS):
                turn = player.step()
                moves = {str(group): array.round(6).tolist() for group, array in player.actions.items()}
                documents.append({"actions": moves} | _turn(turn))
                if not turn.batches:
                    break
        except (Exception, faulty_steps.Interrupt) as error:
            documents.append([type(error).__name__, str(error), *getattr(error, "__notes__", [])])
            if not isinstance(error, LeagueError):  # those of a game, which the match loop names
                documents.append([batched.busy.tolist(), (batched.seconds() > 0).tolist()])
    return (
        [*documents, {"closed": list(faulty_steps.CLOSED)}]
        if name == INTERRUPTED and make is stock_stepping
        else documents
    )


def _turn(turn: Turn) -> dict[str, Any]:
    document = {
        "batches": {str(group): _rows(batch) for group, batch in turn.batches.items()},
        "endings": [[*_rows(rows), rows.terminations.tolist(), rows.truncations.tolist()] for rows in turn.endings],
        "finished": turn.finished.tolist(),
        "crashed": turn.crashed.tolist(),
        "states": _states(turn.states),
        "last_states": _states(turn.last_states),
    }
    return {name: part for name, part in document.items() if part}


def _rows(rows: Batch | AgentRows) -> list[Any]:
    kinds = [f"{name} {array.dtype} {list(array.shape[1:])}" for name, array in rows.observations.items()]
    return [kinds, rows.envs.tolist(), rows.agents.tolist(), rows.rewards.tolist(), _numbers(rows.observations)]


def _numbers(observations: Mapping[str, NDArray]) -> list[float]:
    sums = sum(_sums(array) * (1 + 0.1 * len(name)) for name, array in sorted(observations.items()))
    return np.round(sums, 6).tolist()


def _sums(array: NDArray) -> NDArray[np.float64]:
    rows = np.asarray(array, np.float64).reshape(len(array), -1)
    return rows @ np.cos(np.arange(rows.shape[1]))


def _states(states: States | None) -> list[Any]:
    return [] if states is None else [states.envs.tolist(), _sums(states.values).round(6).tolist()]


def external() -> dict[str, Any]:
    """The episodes of a game that runs in a simulator: tic-tac-toe, and one of a team."""
    return {
        f"{name} in a simulator": _external(config)
        for name, config in (("tic-tac-toe", tictactoe.config()), ("spread", KINDS["team"].config))
    }


def _external(stock: Any) -> dict[str, Any]:
    env = build(stock.environment)
    spaces = {agent: env.action_space(agent) for agent in env.possible_agents}
    with tempfile.TemporaryDirectory() as home:
        registry = simulators.registry(Path(home), simulators.external(stock))
        with (
            closing(simulators.stepping(registry, NUM_ENVS)) as batched,
            simulators.simulating(registry, simulators.pettingzoo(lambda: build(stock.environment))),
        ):
            episodes = lockstep(batched, spaces, list(range(10)), abandon={3: 0, 5: 1, 7: 2})
    return {
        str(seed): {
            agent: [
                [reward, terminated, truncated, *_numbers({name: array[None] for name, array in observed.items()})]
                for _, observed, reward, terminated, truncated in reports
            ]
            for agent, reports in sorted(of_episode.items())
        }
        for seed, of_episode in episodes.items()
    }
