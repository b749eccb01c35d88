"""How fast are matches played, and do more workers help? Connect four with the networks of configs/connect_four.yaml.

Parts: throughput (on one core, in CPU time, from the schedule to the Match records, with ONNX policies on both sides;
compared with the unmodified `env()` with random legal moves and without networks, and with the unmodified `env()` whose
moves are computed by the same networks as RLModules, `forward_inference` for each single move), workers (a tournament,
including the ledger, with two Ray workers and with one, in wall time). Compared measurements alternate within a round;
a rate is the median over the rounds. Networks are untrained, which does not change their inference time.
"""

import argparse
import itertools
import logging
import random
import statistics
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import ray
import torch
from pettingzoo.classic import connect_four_v3
from ray.rllib.core.columns import Columns

from benchmarks.leagues.evaluated_league import CONFIG, publish
from benchmarks.tournaments import adaptive_ranking, rating_speed, tournament_kills
from evaluation.matches.tournament import play_schedule
from evaluation.matches.worker import MatchWorker
from evaluation.schedules.builders import round_robin
from league.registry.registry import Registry
from league.results.records import Match, Schedule
from league.spaces import ACTION_MASK
from training.modules.actor_critic import ActorCritic

VERSIONS = [f"{CONFIG.league}@{number}" for number in (1, 2)]


def throughput(quick: bool) -> bool:
    """At least 0.75 times the unmodified environment, and 3 times the loop with a forward pass for each move."""
    seconds, rounds = (0.7, 3) if quick else (2.0, 9)
    with tempfile.TemporaryDirectory() as home:
        registry, modules = publish(Path(home), 2)
        worker, schedules = MatchWorker(CONFIG, registry), _schedules(registry, blocks=64)
        stock, networks = connect_four_v3.env(), connect_four_v3.env()
        rates = _in_rounds(
            {
                "ours": lambda: _per_second(lambda: _play(worker, next(schedules)), seconds),
                "stock": lambda: _per_second(lambda: _play_game(stock, _at_random), seconds),
                "forward": lambda: _per_second(lambda: _play_game(networks, _by_network(modules)), seconds),
            },
            rounds,
        )
        registry.close()
    print(f"ours {rates['ours']:,.0f}, the stock environment with random legal moves {rates['stock']:,.0f},")
    print(f"with RLModule.forward_inference for each move {rates['forward']:,.0f} moves/s of one core")
    return all(
        [
            _report("ours against the stock environment alone", rates["ours"] / rates["stock"], 0.75),
            _report("ours against a forward pass for each move", rates["ours"] / rates["forward"], 3.0),
        ]
    )


def workers(quick: bool) -> bool:
    """Two workers play at least 1.7 times as fast as one."""
    blocks, rounds = (1024, 1) if quick else (4096, 5)
    with tempfile.TemporaryDirectory() as home:
        registry, _ = publish(Path(home), 2)
        first, schedules = _schedules(registry, 256), _schedules(registry, blocks)

        def measure(count: int) -> float:
            """Games per second with this number of workers, in a Ray with one CPU for each."""
            ray.init(
                address="local", num_cpus=count, include_dashboard=False, log_to_driver=False, logging_level="ERROR"
            )
            try:
                _tournament(next(first), registry, count)  # workers start and load their modules
                return _tournament(next(schedules), registry, count)
            finally:
                ray.shutdown()

        rates = _in_rounds({1: lambda: measure(1), 2: lambda: measure(2)}, rounds, warm_up=False)
        registry.close()
    print(f"one worker {rates[1]:,.0f}, two {rates[2]:,.0f} games/s, in tournaments of {2 * blocks:,} games")
    return _report("two workers against one", rates[2] / rates[1], 1.7)


def _schedules(registry: Registry, blocks: int) -> Any:
    """Successive schedules with different games."""
    row = registry.leagues.get(CONFIG.league)
    return (round_robin(row.config, row.interface, VERSIONS, blocks, seed) for seed in itertools.count())


def _play(worker: MatchWorker, schedule: Schedule) -> int:
    """Play a complete schedule; returns the number of moves."""
    return _moves(worker.play(schedule, range(schedule.length)))


def _moves(matches: Sequence[Match]) -> int:
    return sum(len(game.opening) + len(game.actions) for match in matches for game in match.games)


def _tournament(schedule: Schedule, registry: Registry, count: int) -> float:
    """Games per second."""
    began = time.perf_counter()
    matches = play_schedule(schedule, registry=registry, workers=count)
    return sum(len(match.games) for match in matches) / (time.perf_counter() - began)


def _play_game(env: Any, act: Callable[[str, Any], int]) -> int:
    """Play one game in PettingZoo's loop; returns the number of moves."""
    moves = 0
    env.reset()
    for agent in env.agent_iter():
        observation, _, terminated, truncated, _ = env.last()
        if terminated or truncated:
            env.step(None)
            continue
        env.step(act(agent, observation))
        moves += 1
    return moves


def _at_random(_: str, observation: Any) -> int:
    return random.choice(np.flatnonzero(observation[ACTION_MASK]).tolist())


def _by_network(modules: Sequence[ActorCritic]) -> Callable[[str, Any], int]:
    """The best column by the network of each player."""
    networks = dict(zip(connect_four_v3.env().possible_agents, modules, strict=True))

    def act(agent: str, observation: Any) -> int:
        batch = {name: torch.from_numpy(array[None].copy()) for name, array in observation.items()}
        with torch.no_grad():
            answer = networks[agent].forward_inference({Columns.OBS: batch})
        return int(answer[Columns.ACTION_DIST_INPUTS].argmax())

    return act


def _per_second(play: Callable[[], int], seconds: float) -> float:
    """Moves per second of CPU time, with repeated calls of `play`."""
    moves, began = 0, time.process_time()
    while (elapsed := time.process_time() - began) < seconds:
        moves += play()
    return moves / elapsed


def _in_rounds(measures: Mapping[Any, Callable[[], float]], rounds: int, warm_up: bool = True) -> dict[Any, float]:
    """The median of each measurement over the rounds after a warm-up, in alternation."""
    found: dict[Any, list[float]] = {key: [] for key in measures}
    for _ in range(rounds + warm_up):
        for key, measure in measures.items():
            found[key].append(measure())
    return {key: statistics.median(values[warm_up:]) for key, values in found.items()}


def _report(what: str, ratio: float, target: float) -> bool:
    """Print a ratio with its target; returns whether it is met."""
    print(f"{what}: {ratio:.2f}x (target {target:g}x){'' if ratio >= target else '  BELOW TARGET'}", flush=True)
    return ratio >= target


PARTS: dict[str, Callable[[bool], bool]] = {
    "throughput": throughput,
    "workers": workers,
    "ratings": lambda quick: not rating_speed.run(quick),
    "adaptive": lambda quick: not adaptive_ranking.run(quick),
    "kills": lambda quick: not tournament_kills.run(quick),
}
"""name → function that measures it, quickly or not, and returns whether its targets are met"""


def main() -> int:
    """Run the requested parts; 1 if a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--only", action="append", choices=PARTS, metavar="PART", help=f"parts to run, of {', '.join(PARTS)}"
    )
    parser.add_argument("--quick", action="store_true", help="shorter measurements")
    options = parser.parse_args()
    logging.disable(logging.WARNING)
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    missed = []
    for name in options.only or PARTS:
        print(f"\n-- {name} --", flush=True)
        if not PARTS[name](options.quick):
            missed.append(name)
    print(f"\nmissed: {', '.join(missed)}" if missed else "\nall met")
    return bool(missed)


if __name__ == "__main__":
    sys.exit(main())
