"""What does learning cost in addition to sampling, for algorithms with a replay buffer? One process, one core.

For each configuration: environment steps per second with learning, divided by phase; and of sampling alone, including
networks, exploration and transitions for the buffer, compared with the unmodified environment with random legal actions
and without a network. These two alternate; a rate is the median over the rounds. In one step, all agents to move act.
"""

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

from mpe2 import simple_adversary_v3, simple_spread_v3
from pettingzoo.classic import connect_four_v3, leduc_holdem_v4

from benchmarks.sampling import in_parallel, in_turns
from benchmarks.training.learned import local_ray, one_thread, report_target
from league.config.league import LeagueConfig
from league.environments.building import interface
from training.algorithms.metrics import PHASES, totals
from training.algorithms.off_policy import OffPolicy
from training.runs.trial import build_algorithm
from training.sampling.replay_runner import ReplayRunner

CONFIGS = Path(__file__).parent.parent / "policy_league/configs"
SAMPLING = 0.75
"""Minimum ratio to the rate of the unmodified environment."""


@dataclass(frozen=True, slots=True)
class Phase:
    """module: the unmodified environment. bare: its steps per second. agents: number of agents that act in a step."""

    module: ModuleType
    bare: Callable[[ModuleType, float], float]
    agents: int


PARTS = {
    "leduc_holdem_dqn": Phase(leduc_holdem_v4, in_turns, 1),
    "connect_four_dqn": Phase(connect_four_v3, in_turns, 1),
    "simple_spread_qmix": Phase(simple_spread_v3, in_parallel, 3),
    "simple_adversary": Phase(simple_adversary_v3, in_parallel, 3),
}


def measure(name: str, part: Phase, seconds: float, rounds: int) -> bool:
    """Print the two lines of one configuration."""
    # Opponents would need networks or scripts, which the unmodified environment does not run either.
    league = LeagueConfig.load(CONFIGS / f"{name}.yaml").with_training(runners=0, learning_starts=1000, opponents=[])
    algorithm = build_algorithm(league, interface(league))
    assert isinstance(algorithm, OffPolicy)
    algorithm.reset_episodes(0)
    rate, phases = learning(algorithm, part, seconds)
    split = ", ".join(f"{phase} {share:.0%}" for phase, share in phases.items())
    print(f"{name} ({league.training.algorithm}): learning on {rate:,.0f} environment steps/s: {split}")
    runner = algorithm.env_runner_group.local_env_runner
    assert isinstance(runner, ReplayRunner)
    rates: dict[str, list[float]] = {"sampling": [], "bare": []}
    for _ in range(rounds):
        rates["sampling"].append(sampling_rate(runner, part, algorithm.settings.exploration.final, seconds / 10))
        rates["bare"].append(part.bare(part.module, seconds / 10))
    algorithm.stop()
    ours, bare = (statistics.median(each) for each in rates.values())
    print(f"{name}: sampling alone {ours:,.0f}, the stock environment {bare:,.0f} environment steps/s")
    return report_target(
        f"{name}, sampling {ours / bare:.2f}× of the bare environment", f"{SAMPLING}×", ours >= SAMPLING * bare
    )


def learning(algorithm: OffPolicy, part: Phase, seconds: float) -> tuple[float, dict[str, float]]:
    """Environment steps per second after the first transitions, and the fraction of each phase; the rest is `other`."""
    while algorithm.steps < algorithm.settings.learning_starts * part.agents:
        algorithm.train()
    phases, first, began = dict.fromkeys(PHASES, 0.0), algorithm.steps, time.perf_counter()
    while (elapsed := time.perf_counter() - began) < seconds:
        taken = totals(algorithm.train())
        phases = {phase: value + taken[phase] for phase, value in phases.items()}
    shares = {phase.removeprefix("time/"): value / elapsed for phase, value in phases.items()}
    return (algorithm.steps - first) / part.agents / elapsed, shares | {"other": 1 - sum(shares.values())}


def sampling_rate(runner: ReplayRunner, part: Phase, exploration: float, seconds: float) -> float:
    """Environment steps per second of play with exploration, including transitions for the buffer."""
    steps, began = 0, time.perf_counter()
    while (elapsed := time.perf_counter() - began) < seconds:
        steps += runner.transitions(part.agents * 1000, exploration)[0]
    return steps / part.agents / elapsed


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the requested configurations; 1 if a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"some of {', '.join(PARTS)}; default: all")
    parser.add_argument("--quick", action="store_true", help="a few seconds each")
    given = parser.parse_args(arguments)
    if unknown := [part for part in given.parts if part not in PARTS]:
        parser.error(f"no part {', '.join(unknown)}: expected some of {', '.join(PARTS)}")
    one_thread()
    with local_ray(cpus=1):
        seconds, rounds = (5.0, 3) if given.quick else (40.0, 7)
        missed = [name for name in given.parts or PARTS if not measure(name, PARTS[name], seconds, rounds)]
    print(f"\nmissed: {', '.join(missed)}" if missed else "\nall met")
    return bool(missed)


if __name__ == "__main__":
    sys.exit(main())
