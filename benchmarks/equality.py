"""Are vectorised environments equal to the stock environments, bit for bit?

The stock environment gets the same seeds and actions as the vectorised one, 64 copies of each. Copies rest, start at
different times and abandon episodes. Every array of every report is compared, with its data type. Environment steps are
counted: one move in a turn-based game, one action of each agent in the others. MPE environments play half of them with
discrete and half with continuous actions.
"""

import argparse
import os
import sys
from concurrent.futures import ProcessPoolExecutor

from league.config.environment import EnvironmentConfig
from league.environments.implementation import VECTORISED, implementation
from league.environments.vector.equality import Comparison, compare

STEPS = 10**6
NUM_ENVS = 64
SEED = 0
KUHN_POKER = EnvironmentConfig(
    entry_point="policy_league.examples.kuhn_poker:env",
    vector="policy_league.examples.kuhn_poker_vector:KuhnPokerVector",
)


def main() -> int:
    """Print steps and differences for each environment; 1 if any differ or are not vectorised here."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a hundredth of the steps")
    parser.add_argument("--processes", type=int, default=os.cpu_count(), help="default: one per core")
    options = parser.parse_args()
    cases = [(config, (STEPS // 100 if options.quick else STEPS) // len(kinds)) for kinds in CASES for config in kinds]
    failed = False
    with ProcessPoolExecutor(options.processes) as pool:
        for (config, _), found in zip(cases, pool.map(_compared, *zip(*cases, strict=True)), strict=True):
            failed |= found.difference is not None
            kind = " ".join(f"{key}={value}" for key, value in config.kwargs.items())
            print(
                f"{config.entry_point:>36} {kind:<24} {found.steps:>9,} steps, {found.episodes:>7,} episodes:"
                f" {found.difference or '0 differences'}",
                flush=True,
            )
    return int(failed)


def _compared(config: EnvironmentConfig, steps: int) -> Comparison:
    chosen = implementation(config)
    if chosen.vector is None:
        raise SystemExit(f"{config.entry_point}: {chosen.reason}")
    return compare(config, chosen.vector(NUM_ENVS, **config.kwargs), steps, SEED)


def _kinds(entry_point: str) -> list[EnvironmentConfig]:
    if not entry_point.startswith("mpe2."):
        return [EnvironmentConfig(entry_point=entry_point)]
    return [EnvironmentConfig(entry_point=entry_point, kwargs={"continuous_actions": kind}) for kind in (False, True)]


CASES = [*map(_kinds, VECTORISED), [KUHN_POKER]]
"""Each environment, with its kinds of actions."""


if __name__ == "__main__":
    sys.exit(main())
