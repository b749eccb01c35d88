"""The parts of `benchmarks.learning` with DQN: Leduc hold'em, and connect four. All seeds are printed."""

import itertools
import multiprocessing
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from ray.rllib.algorithms.algorithm import Algorithm
from scipy.stats import binomtest

from benchmarks.training.learned import interval, local_ray, one_thread, report_target
from benchmarks.training.leduc import best_response, greedy, uniform
from benchmarks.training.matches import games, graph
from league.config.league import LeagueConfig
from league.environments.building import interface
from training.runs.trial import build_algorithm

CONFIGS = Path(__file__).parents[2] / "policy_league/configs"
SEEDS = range(3)
RLCARD, BEST = 1.21, 1.4716
"""Return per hand of Leduc against a random opponent: RLCard's DQN, and the exact best response."""
HANDS, GAMES, MOVES = 100_000, 2000, 1_000_000


@dataclass(frozen=True, slots=True)
class Outcome:
    """Results of one seed: actions and CPU seconds of training, and measurements by name."""

    steps: int
    seconds: float
    measured: dict[str, float]
    curve: tuple[tuple[int, float], ...] = ()
    """Actions, and a measurement at that time."""


def leduc_vs_random(scale: float) -> bool:
    """Winnings against a random opponent, over hands on both sides."""
    met = True
    for seed, found in zip(SEEDS, _work(_against_random, scale), strict=True):
        low, mean = found.measured["low"], found.measured["mean"]
        met &= low >= RLCARD
        print(
            f"seed {seed}: {found.steps:,} actions in {found.seconds:.0f} s; {mean:+.3f} per hand over"
            f" {found.measured['hands']:,.0f} hands, lower 95 % bound {low:+.3f} (best response {BEST:+.4f})"
        )
    return report_target("lower bound of each seed", f"{RLCARD:+.2f}", met)


def leduc_holdem_dqn(scale: float) -> bool:
    """Exploitability in self-play: the winnings of an exact best response, over training."""
    met, random = True, best_response(uniform)
    print(f"uniform play: {random:.4f}")
    for seed, found in zip(SEEDS, _work(_exploitability, scale), strict=True):
        first, last = found.curve[0][1], found.curve[-1][1]
        met &= last < min(first, random)
        shown = ", ".join(f"{steps // 1000}k {value:.2f}" for steps, value in found.curve)
        print(f"seed {seed}: {found.steps:,} actions in {found.seconds:.0f} s; exploitability at {shown}")
    return report_target("exploitability at the end", "below uniform play's and the first checkpoint's", met)


def connect_four_dqn(scale: float) -> bool:
    """The fraction of wins against random play with openings, and whether any of a million moves was illegal."""
    met = True
    for seed, found in zip(SEEDS, _work(_connect_four, scale), strict=True):
        met &= found.measured["low"] >= 0.95
        print(
            f"seed {seed}: {found.steps:,} actions in {found.seconds:.0f} s; won {found.measured['won']:.2%} of"
            f" {found.measured['games']:,.0f} games, lower 95 % bound {found.measured['low']:.2%};"
            f" {found.measured['moves']:,.0f} moves, none illegal"
        )
    return report_target("lower bound of each seed", "95 %", met)


def _work(one: Callable[[int, float], Outcome], scale: float) -> list[Outcome]:
    """Run each seed, two at a time, on one core each."""
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(2, mp_context=spawn, max_tasks_per_child=1) as pool:
        return list(pool.map(one, SEEDS, [scale] * len(SEEDS)))


def _against_random(seed: int, scale: float) -> Outcome:
    def measure(algorithm: Algorithm, league: LeagueConfig) -> dict[str, float]:
        played = games(graph(algorithm, league), league, "script:random", int(HANDS * min(1.0, 10 * scale)))
        returns = np.array([game.returns[0] for game in played])
        return {"mean": float(returns.mean()), "low": interval(returns)[0], "hands": len(returns)}

    return _train("leduc_vs_random", seed, scale, measure)


def _exploitability(seed: int, scale: float) -> Outcome:
    return _train("leduc_holdem_dqn", seed, scale, lambda *_: {}, exploitability)


def _connect_four(seed: int, scale: float) -> Outcome:
    def measure(algorithm: Algorithm, league: LeagueConfig) -> dict[str, float]:
        trained, moves = graph(algorithm, league), 0
        first = games(trained, league, "script:random", GAMES)
        # Other opponents reach other positions; an illegal move in any game ends the benchmark.
        for round_ in itertools.count(1):
            opponent = ("script:random", "script:one_ply")[round_ % 2]
            moves += sum(len(game.actions) // 2 for game in games(trained, league, opponent, 10 * GAMES, round_))
            if moves >= MOVES * min(1.0, 10 * scale):
                break
        won = [game.scores[0] for game in first].count(1.0)
        low = binomtest(won, len(first)).proportion_ci(0.95, "wilson").low
        return {"won": won / len(first), "low": low, "games": len(first), "moves": moves}

    return _train("connect_four_dqn", seed, scale, measure)


def exploitability(algorithm: Algorithm, league: LeagueConfig) -> float:
    """Winnings of a best response per hand against the current policy."""
    return best_response(greedy(graph(algorithm, league)))


def _train(
    name: str,
    seed: int,
    scale: float,
    measure: Callable[[Algorithm, LeagueConfig], dict[str, float]],
    measure_checkpoint: Callable[[Algorithm, LeagueConfig], float] | None = None,
) -> Outcome:
    """Train a configuration for its budget of actions. measure_checkpoint: called at each checkpoint."""
    one_thread()
    league = LeagueConfig.load(CONFIGS / f"{name}.yaml").with_training(runners=0, seed=seed)
    settings = league.training
    budget = settings.max_steps
    assert budget is not None, f"{name} has a budget of actions"
    every = settings.checkpoint_steps or budget
    checkpoints: Sequence[int] = [*range(every, budget, every), budget]
    with local_ray(cpus=1):
        algorithm = build_algorithm(league, interface(league))
        try:
            algorithm.reset_episodes(0)
            seconds, curve = 0.0, []
            for checkpoint in (int(steps * scale) for steps in checkpoints):
                began = time.process_time()
                while algorithm.steps < checkpoint:
                    algorithm.train()
                seconds += time.process_time() - began
                if measure_checkpoint is not None:
                    curve.append((algorithm.steps, measure_checkpoint(algorithm, league)))
            return Outcome(algorithm.steps, seconds, measure(algorithm, league), tuple(curve))
        finally:
            algorithm.stop()
