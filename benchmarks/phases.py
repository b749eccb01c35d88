"""What does learning cost in addition to sampling, for algorithms with a replay buffer?

One process, one core.

For each configuration: environment steps per second with learning, divided by phase; and of sampling alone, including
networks, exploration and transitions for the buffer, compared with the unmodified environment with random legal actions
and without a network. These two alternate; a rate is the median over the rounds. In one step, all agents to move act.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import ModuleType

from mpe2 import simple_adversary_v3, simple_spread_v3
from pettingzoo.classic import connect_four_v3, leduc_holdem_v4

from benchmarks.harness import CONFIGS, Parts, Quick, Target, chosen, in_rounds, rate
from benchmarks.sampling import in_parallel, in_turns
from benchmarks.training.learned import local_ray, one_thread
from league.config.league import LeagueConfig
from league.environments.building import interface
from training.algorithms.metrics import PHASES, totals
from training.algorithms.off_policy import OffPolicy
from training.runs.trial import build_algorithm
from training.sampling.replay_runner import ReplayRunner

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


def measure(name: str, part: Phase, seconds: float, rounds: int) -> Iterator[Target]:
    """Measure one configuration."""
    # Opponents would need networks or scripts, which the unmodified environment does not run either.
    league = LeagueConfig.load(CONFIGS / f"{name}.yaml").with_training(runners=0, learning_starts=1000, opponents=[])
    algorithm = build_algorithm(league, interface(league))
    assert isinstance(algorithm, OffPolicy)
    algorithm.reset_episodes(0)
    steps, phases = learning(algorithm, part, seconds)
    note = ", ".join(f"{phase} {share:.0%}" for phase, share in phases.items())
    yield Target(f"{name}, with learning", round(steps), "steps/s", note=note)
    runner = algorithm.env_runner_group.local_env_runner
    assert isinstance(runner, ReplayRunner)
    exploration = algorithm.settings.exploration.final

    def sample() -> float:
        return runner.transitions(part.agents * 1000, exploration)[0] / part.agents

    rates = in_rounds(
        {"ours": lambda: rate(sample, seconds / 10), "stock": lambda: part.bare(part.module, seconds / 10)}, rounds
    )
    algorithm.stop()
    note = f"{rates['ours']:,.0f} to {rates['stock']:,.0f} steps/s"
    ratio = rates["ours"] / rates["stock"]
    yield Target(f"{name}, sampling", ratio, "×", at_least=SAMPLING, peer="the stock environment", note=note)


def learning(algorithm: OffPolicy, part: Phase, seconds: float) -> tuple[float, dict[str, float]]:
    """Environment steps per second after the first transitions, and the fraction of each phase; the rest is `other`."""
    while algorithm.steps < algorithm.settings.learning_starts * part.agents:
        algorithm.train()
    phases, first, began = dict.fromkeys(PHASES, 0.0), algorithm.steps, time.perf_counter()
    while (elapsed := time.perf_counter() - began) < seconds:
        times = totals(algorithm.train())
        phases = {phase: value + times.get(phase, 0.0) for phase, value in phases.items()}
    shares = {phase.removeprefix("time/"): value / elapsed for phase, value in phases.items()}
    return (algorithm.steps - first) / part.agents / elapsed, shares | {"other": 1 - sum(shares.values())}


def main(parts: Parts = None, quick: Quick = False) -> Iterator[Target]:
    """Measure the configurations."""
    configurations = chosen(parts, PARTS)
    one_thread()
    with local_ray(cpus=1):
        for name, part in configurations.items():
            yield from measure(name, part, *(5.0, 3) if quick else (40.0, 7))
