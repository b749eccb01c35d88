"""The parts of `benchmarks.learning` with DQN: Leduc hold'em, and connect four. All seeds are printed."""

import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from ray.rllib.algorithms.algorithm import Algorithm

from benchmarks.harness import CONFIGS, Target
from benchmarks.training.learned import in_processes, interval, local_ray, one_thread
from benchmarks.training.leduc import best_response, greedy, uniform
from benchmarks.training.matches import games, graph, lower_bound
from league.config.league import LeagueConfig
from league.environments.building import interface
from training.runs.trial import build_algorithm

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


def leduc_vs_random(scale: float) -> Iterator[Target]:
    """Winnings against a random opponent, over hands on both sides."""
    outcomes = _work(_against_random, scale)
    lows = tuple(round(outcome.measured["low"], 3) for outcome in outcomes)
    means = ", ".join(f"{outcome.measured['mean']:+.3f}" for outcome in outcomes)
    note = f"means {means}; best response {BEST:+.4f}"
    yield Target("leduc_vs_random, gain per hand, lower bound", lows, at_least=RLCARD, peer="RLCard's DQN", note=note)


def leduc_holdem_dqn(scale: float) -> Iterator[Target]:
    """Exploitability in self-play: the winnings of an exact best response, over training."""
    random = best_response(uniform)
    for seed, outcome in zip(SEEDS, _work(_exploitability, scale), strict=True):
        values = tuple(round(value, 3) for _, value in outcome.curve)
        yield Target(f"leduc_holdem_dqn, exploitability, seed {seed}", values)
        name = f"leduc_holdem_dqn, final exploitability, seed {seed}"
        yield Target(name, values[-1], at_most=min(values[0], random))


def connect_four_dqn(scale: float) -> Iterator[Target]:
    """The fraction of wins against random play with openings, and whether any of a million moves was illegal."""
    outcomes = _work(_connect_four, scale)
    lows = tuple(round(outcome.measured["low"], 2) for outcome in outcomes)
    # An illegal move would have ended the games with an error.
    note = f"{sum(outcome.measured['moves'] for outcome in outcomes):,.0f} legal moves"
    yield Target("connect_four_dqn against random play, lower bound", lows, "%", at_least=95.0, note=note)


def _work(train: Callable[[tuple[int, float]], Outcome], scale: float) -> list[Outcome]:
    """Run each seed on one core."""
    return list(in_processes(train, [(seed, scale) for seed in SEEDS]))


def _against_random(job: tuple[int, float]) -> Outcome:
    def measure(algorithm: Algorithm, league: LeagueConfig) -> dict[str, float]:
        played = games(graph(algorithm, league), league, "script:random", int(HANDS * min(1.0, 10 * job[1])))
        returns = np.array([game.returns[0] for game in played])
        return {"mean": float(returns.mean()), "low": interval(returns)[0], "hands": len(returns)}

    return _train("leduc_vs_random", *job, measure)


def _exploitability(job: tuple[int, float]) -> Outcome:
    return _train("leduc_holdem_dqn", *job, lambda *_: {}, exploitability)


def _connect_four(job: tuple[int, float]) -> Outcome:
    def measure(algorithm: Algorithm, league: LeagueConfig) -> dict[str, float]:
        trained, moves = graph(algorithm, league), 0
        first = games(trained, league, "script:random", GAMES)
        # Other opponents reach other positions; an illegal move in any game ends the benchmark.
        for round_ in itertools.count(1):
            opponent = ("script:random", "script:one_ply")[round_ % 2]
            moves += sum(len(game.actions) // 2 for game in games(trained, league, opponent, 10 * GAMES, round_))
            if moves >= MOVES * min(1.0, 10 * job[1]):
                break
        return {"low": lower_bound(first), "moves": moves}

    return _train("connect_four_dqn", *job, measure)


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
