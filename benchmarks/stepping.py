"""Stepping without a network, through the protocol of training and matches, compared with the unmodified environments,
all with random legal actions.

The unmodified environment is PettingZoo's `env()` or `parallel_env()`, in PettingZoo's loop; its resets have no seed,
which saves some work, while each of ours has one. For pistonball it is SuperSuit's stack on the raw parallel
environment, without the checking wrappers. Rates are environment steps (moves, in a turn-based game) per second of
processor time; the two alternate within a round, and a rate is the median over the rounds.
"""

import logging
import os
import random
import warnings
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from time import process_time
from typing import Any

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")

import numpy as np
import supersuit
from mpe2 import simple_adversary_v3, simple_spread_v3, simple_tag_v3
from pettingzoo.butterfly.pistonball import pistonball
from pettingzoo.classic import connect_four_v3, leduc_holdem_v4, tictactoe_v3
from pettingzoo.utils.conversions import aec_to_parallel_wrapper

from benchmarks.harness import Quick, Target, in_rounds, rate
from benchmarks.stock import moves
from league.config.environment import EnvironmentConfig
from league.environments.building import build
from league.environments.implementation import stepping
from league.environments.stepping import Batch, Indices, Starts
from league.spaces import ACTION_MASK

RENDERED = {"render_mode": "rgb_array"}
"""Without it, pistonball renders nothing, and all its observations are the same."""
STACK = [
    {"color_reduction_v0": {"mode": "B"}},
    {"resize_v1": {"x_size": 84, "y_size": 84}},
    {"frame_stack_v1": {"stack_size": 4}},
]


@dataclass(frozen=True)
class Case:
    """One environment. stock: steps the unmodified environment endlessly, yielding at each step. fast_seeds: step ours
    as training with `training.seeds: fast` does."""

    config: EnvironmentConfig
    num_envs: int
    stock: Callable[[], Iterator[None]]
    target: float
    fast_seeds: bool = False


def main(quick: Quick = False) -> Iterator[Target]:
    """Measure all environments."""
    logging.disable(logging.WARNING)
    warnings.simplefilter("ignore")
    for name, case in CASES.items():
        rates = measure(case, rounds=3 if quick else 9, seconds=0.4 if quick else 1.0)
        note = f"{rates['ours']:,.0f} to {rates['stock']:,.0f} steps/s"
        yield Target(name, rates["ours"] / rates["stock"], "×", at_least=case.target, peer="stock", note=note)


def measure(case: Case, rounds: int, seconds: float) -> dict[str, float]:
    """Steps per second of our and of the unmodified environment."""
    ours, stock = batched(case.config, case.num_envs, case.fast_seeds), case.stock()
    measures = {
        "ours": lambda: rate(lambda: next(ours) or case.num_envs, seconds, process_time),
        "stock": lambda: rate(lambda: next(stock) or 1, seconds, process_time),
    }
    in_rounds(measures, 1)  # a warm-up
    return in_rounds(measures, rounds)


def batched(config: EnvironmentConfig, num_envs: int, fast_seeds: bool = False) -> Iterator[None]:
    """All environments, one step in each at a time."""
    env, rng, groups = stepping(config, num_envs, fast_seeds=fast_seeds), np.random.default_rng(0), groups_of(config)

    def next_episodes(envs: Indices) -> Starts:
        return Starts(envs, rng.integers(2**31, size=len(envs)), np.tile(groups, (len(envs), 1)))

    turn = env.start(next_episodes)
    space = DRAWS[config.entry_point]
    while True:
        turn = env.step({group: space(batch, rng) for group, batch in turn.batches.items()})
        yield


def groups_of(config: EnvironmentConfig) -> list[int]:
    """A group for each kind of observation."""
    with closing(build(config)) as env:
        spaces = [env.observation_space(agent) for agent in env.possible_agents]
    return [spaces.index(space) for space in spaces]


def masked(batch: Batch, rng: np.random.Generator) -> Any:
    """A legal action for each row."""
    mask = batch.observations[ACTION_MASK]
    return (rng.random(mask.shape) * (mask != 0)).argmax(axis=1)


def aec_loop(env: Any) -> Iterator[None]:
    """PettingZoo's loop for a game with masks."""
    while True:
        yield from moves(env, lambda _, observation: random.choice(np.flatnonzero(observation[ACTION_MASK]).tolist()))


def parallel_loop(env: Any, act: Callable[[], Any]) -> Iterator[None]:
    """PettingZoo's loop for an environment in which all agents act at once."""
    while True:
        env.reset()
        while env.agents:
            env.step({agent: act() for agent in env.agents})
            yield


def stock_pistonball() -> Iterator[None]:
    """SuperSuit's stack on the raw parallel environment."""
    env = aec_to_parallel_wrapper(pistonball.raw_env(**RENDERED))
    for wrapper in STACK:
        for name, arguments in wrapper.items():
            env = getattr(supersuit, name)(env, **arguments)
    rng = np.random.default_rng(0)
    return parallel_loop(env, lambda: rng.uniform(-1, 1, 1).astype(np.float32))


def five(batch: Batch, rng: np.random.Generator) -> Any:
    """One of MPE's actions for each row."""
    return rng.integers(5, size=len(batch))


DRAWS: dict[str, Callable[[Batch, np.random.Generator], Any]] = {
    "mpe2.simple_spread_v3": five,
    "mpe2.simple_adversary_v3": five,
    "mpe2.simple_tag_v3": five,
    "pettingzoo.classic.connect_four_v3": masked,
    "pettingzoo.classic.tictactoe_v3": masked,
    "pettingzoo.classic.leduc_holdem_v4": masked,
    "pettingzoo.butterfly.pistonball_v6": lambda batch, rng: rng.uniform(-1, 1, (len(batch), 1)).astype(np.float32),
}
VECTOR_ENVS = 1024
"""Copies of a vectorised environment."""


def classic(name: str, module: Any, target: float, fast_seeds: bool = False) -> Case:
    """A game of PettingZoo with masks."""
    config = EnvironmentConfig(entry_point=f"pettingzoo.classic.{name}")
    return Case(config, VECTOR_ENVS, lambda: aec_loop(module.env()), target, fast_seeds)


def mpe(name: str, module: Any, target: float) -> Case:
    """An environment of MPE with discrete actions."""
    stock = partial(random.randrange, 5)
    return Case(
        EnvironmentConfig(entry_point=f"mpe2.{name}"),
        VECTOR_ENVS,
        lambda: parallel_loop(module.parallel_env(), stock),
        target,
    )


CASES = {
    "connect_four": classic("connect_four_v3", connect_four_v3, 100),
    "tictactoe": classic("tictactoe_v3", tictactoe_v3, 100),
    "leduc_holdem": classic("leduc_holdem_v4", leduc_holdem_v4, 20),
    "leduc_holdem with fast seeds": classic("leduc_holdem_v4", leduc_holdem_v4, 150, fast_seeds=True),
    "simple_spread": mpe("simple_spread_v3", simple_spread_v3, 100),
    "simple_adversary": mpe("simple_adversary_v3", simple_adversary_v3, 80),
    "simple_tag": mpe("simple_tag_v3", simple_tag_v3, 80),
    "pistonball with its wrappers": Case(
        EnvironmentConfig.model_validate(
            {"entry_point": "pettingzoo.butterfly.pistonball_v6", "kwargs": RENDERED, "wrappers": STACK}
        ),
        4,
        stock_pistonball,
        1.5,
    ),
}
