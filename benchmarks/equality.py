"""Are vectorised environments equal to the stock environments, bit for bit?

The stock environment gets the same seeds and actions as the vectorised one, 64 copies of each. Copies rest, start at
different times and abandon episodes. Every array of every report is compared, with its data type. Environment steps are
counted: one move in a turn-based game, one action of each agent in the others. MPE environments play half of them with
discrete and half with continuous actions.
"""

import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from typing import Annotated

import typer

from benchmarks.harness import Quick, Target
from league.config.environment import EnvironmentConfig
from league.environments.equality import Comparison, compare
from league.environments.implementation import VECTORISED, implementation

STEPS = 10**6
NUM_ENVS = 64
SEED = 0
KUHN_POKER = EnvironmentConfig(
    entry_point="policy_league.examples.kuhn_poker:env",
    vector="policy_league.examples.kuhn_poker_vector:KuhnPokerVector",
)


def main(
    quick: Quick = False,
    processes: Annotated[int | None, typer.Option(help="default: one per core")] = None,
) -> Iterator[Target]:
    """Compare all environments, which must be vectorised here."""
    cases = [(config, (STEPS // 100 if quick else STEPS) // len(kinds)) for kinds in CASES for config in kinds]
    with ProcessPoolExecutor(processes or os.cpu_count()) as pool:
        for (config, _), comparison in zip(cases, pool.map(_compared, *zip(*cases, strict=True)), strict=True):
            name = " ".join([config.entry_point, *(f"{key}={value}" for key, value in config.kwargs.items())])
            note = f"{comparison.steps:,} steps, {comparison.episodes:,} episodes"
            if comparison.difference is not None:
                note += f": {comparison.difference}"
            yield Target(name, int(comparison.difference is not None), "differences", at_most=0, note=note)


def _compared(config: EnvironmentConfig, steps: int) -> Comparison:
    vectorised = implementation(config)
    if vectorised.vector is None:
        raise SystemExit(f"{config.entry_point}: {vectorised.reason}")
    return compare(config, vectorised.vector(NUM_ENVS, **config.kwargs), steps, SEED)


def _kinds(entry_point: str) -> list[EnvironmentConfig]:
    if not entry_point.startswith("mpe2."):
        return [EnvironmentConfig(entry_point=entry_point)]
    return [EnvironmentConfig(entry_point=entry_point, kwargs={"continuous_actions": kind}) for kind in (False, True)]


CASES = [*map(_kinds, VECTORISED), [KUHN_POKER]]
"""Each environment, with its kinds of actions."""
