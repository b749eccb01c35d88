"""How fast are matches played, and do more workers help? Connect four, on one core unless workers are compared.

Parts: throughput (in CPU time, from the schedule to the Match records, with ONNX policies on both sides: MLPs of 2×256
and the convolutional networks of the bundled connect_four; compared with the unmodified `env()` with random legal
moves and without networks, and with the unmodified `env()` whose moves are computed by the same networks as RLModules,
`forward_inference` for each single move), verdict (4,000 games with MLPs of 2×256: schedule, games, sequential test,
ledger, gate result and report; in wall and in CPU time), workers (a tournament, including the ledger, with two Ray
workers and with one, in wall time). Compared measurements alternate within a round; a rate is the median over the
rounds. Networks are untrained, which does not change their inference time.
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

from benchmarks.leagues.evaluated_league import CONFIG, publish, with_mlp
from benchmarks.tournaments import adaptive_ranking, rating_speed, tournament_kills
from evaluation.gating.verdicts import conclude, open_verdict
from evaluation.matches.tournament import play_schedule
from evaluation.matches.worker import MatchWorker
from evaluation.schedules.builders import round_robin
from league.config.league import LeagueConfig
from league.refs import CHAMPION
from league.registry.registry import Registry
from league.results.records import Match, Schedule
from league.spaces import ACTION_MASK
from training.modules.actor_critic import ActorCritic

VERSIONS = [f"{CONFIG.league}@{number}" for number in (1, 2)]
MLP = with_mlp(CONFIG)
VERDICT_BLOCKS = 2000
VERDICT_SECONDS = 0.5
"""Most seconds for a verdict of so many blocks of two games."""


def throughput(quick: bool) -> bool:
    """With MLPs at least 12 times the unmodified environment; 3 times the loop with a forward pass for each move."""
    return all([_throughput("MLP 2×256", MLP, quick, 12.0), _throughput("convolutional", CONFIG, quick, None)])


def _throughput(name: str, config: LeagueConfig, quick: bool, target: float | None) -> bool:
    seconds, rounds = (0.7, 3) if quick else (2.0, 9)
    with tempfile.TemporaryDirectory() as home:
        registry, modules = publish(Path(home), 2, config)
        worker, schedules = MatchWorker(config, registry), _schedules(registry, blocks=1024)
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
    print(f"{name}: ours {rates['ours']:,.0f}, the stock environment with random legal moves {rates['stock']:,.0f},")
    print(f"with RLModule.forward_inference for each move {rates['forward']:,.0f} moves/s of one core")
    return all(
        [
            _report("ours against the stock environment alone", rates["ours"] / rates["stock"], target),
            _report("ours against a forward pass for each move", rates["ours"] / rates["forward"], 3.0),
        ]
    )


def verdict(quick: bool) -> bool:
    """A verdict of 4,000 games in at most 0.5 s."""
    # Bounds that no test reaches, so that each verdict plays all of its games.
    unbounded = {"alpha": 1e-200, "beta": 1e-200, "max_blocks": VERDICT_BLOCKS, "nights": None}
    config = MLP.model_copy(update={"gate": MLP.gate.model_copy(update=unbounded)})
    with tempfile.TemporaryDirectory() as home:
        registry, _ = publish(Path(home), 2, config)
        registry.aliases.set(config.league, CHAMPION, 1, expected=None, actor="benchmark", reason="first")
        # One before the measurements, which loads the policies.
        times = [_verdict_times(registry, config) for _ in range(1 + (3 if quick else 11))][1:]
        registry.close()
    wall, cpu = (statistics.median(column) for column in zip(*times, strict=True))
    print(
        f"a verdict of {2 * VERDICT_BLOCKS:,} games: {wall:.3f} s, in CPU time {cpu:.3f} s; target {VERDICT_SECONDS} s"
    )
    return cpu <= VERDICT_SECONDS


def _verdict_times(registry: Registry, config: LeagueConfig) -> tuple[float, float]:
    """Wall and CPU seconds of one verdict."""
    began = time.perf_counter(), time.process_time()
    opened = open_verdict(registry, registry.leagues.get(config.league), 2, VERSIONS[0])
    report = conclude(registry, opened)
    ended = time.perf_counter(), time.process_time()
    assert (report.outcome, report.blocks) == ("inconclusive", VERDICT_BLOCKS)
    return ended[0] - began[0], ended[1] - began[1]


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


def _report(what: str, ratio: float, target: float | None) -> bool:
    """Print a ratio with its target; returns whether it is met."""
    if target is None:
        print(f"{what}: {ratio:.2f}x", flush=True)
        return True
    print(f"{what}: {ratio:.2f}x (target {target:g}x){'' if ratio >= target else '  BELOW TARGET'}", flush=True)
    return ratio >= target


PARTS: dict[str, Callable[[bool], bool]] = {
    "throughput": throughput,
    "verdict": verdict,
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
