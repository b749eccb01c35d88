"""How often do intervals hold the true value that they claim to hold with 95 %?

Every interval that is printed, but those of ratings (`ladders`), from samples of a fixed size unless said otherwise:
ordinary ones, small ones and lopsided ones. Blocks are two games whose results add up to one of five scores.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from benchmarks.harness import Target
from benchmarks.simulations import exploiter_gates
from benchmarks.simulations.simulated_gates import CELLS, EQUALS, stronger
from evaluation.documents import Estimate
from evaluation.gating.criteria.exploitability import exploitability_bound
from evaluation.gating.gate import decide
from evaluation.statistics.improvement import iqm, probability_of_improvement, stratified_bootstrap
from evaluation.statistics.payoff import cross_play_table, score_interval, student_interval
from evaluation.statistics.population import population
from evaluation.statistics.sequential import elo_estimate, elo_of
from league.config.gate import GateConfig
from league.results.equilibria import alpha_rank, nash_averaging
from league.results.records import GAMES_PER_BLOCK, Game, Match
from league.results.sums import GameSums, PairSums
from tests.support.leagues.payoff_matches import match

LEAST = 93.0
"""Percent. An interval that covers less is described in docs/statistics.md."""
BLOCKS = (200, 32, 8)
ADVANTAGES = {"even": 0.0, "+200 Elo": 200.0, "+500 Elo": 500.0}
RESAMPLES = 400

Floats = NDArray[np.float64]
Bounds = tuple[float | None, float | None]


def run(draws: int) -> Iterator[Target]:
    """Simulate all intervals. draws: of each case."""
    for part in (_of_blocks, _of_verdicts, _of_exploiters, _of_populations, _of_runs, _of_teams):
        yield from part(draws)


def _target(name: str, *shares: float) -> Target:
    percents = [round(100 * share, 1) for share in shares]
    return Target(name, percents[0] if len(percents) == 1 else tuple(percents), "%", at_least=LEAST)


def _share(bounds: Iterable[Bounds], truth: float) -> float:
    """Share of intervals that hold the truth. One without bounds claims nothing, and holds it."""
    return float(np.mean([low is None or high is None or low <= truth <= high for low, high in bounds]))


def _of_blocks(draws: int) -> Iterator[Target]:
    """Mean scores, Elo and differences of returns over blocks."""
    sizes = f"{', '.join(map(str, BLOCKS))} blocks"
    for kind in ("decisive", "drawish"):
        for strength, elo in ADVANTAGES.items():
            shares = stronger(EQUALS[kind], elo, "logistic")
            mean, rng = float(shares @ CELLS), np.random.default_rng(5)
            held: dict[str, list[float]] = {"score (Wilson)": [], "Elo": [], "difference (Student)": []}
            for blocks in BLOCKS:
                counts = rng.multinomial(blocks, shares, size=draws)
                scores = [np.repeat(CELLS, row).tolist() for row in counts]
                estimates, gaps = map(elo_estimate, counts), map(student_interval, scores)
                held["score (Wilson)"].append(_share((score_interval(row)[1:] for row in scores), mean))
                held["Elo"].append(_share(((e.low, e.high) for e in estimates), float(elo_of(mean))))
                held["difference (Student)"].append(_share(((gap.low, gap.high) for gap in gaps), mean))
            for formula, numbers in held.items():
                yield _target(f"{formula}: {kind}, {strength}, {sizes}", *numbers)
    rng, numbers = np.random.default_rng(6), []
    for blocks in BLOCKS:
        returns = np.where(rng.random((draws, blocks)) < 0.02, 50.0, 0.0) + rng.normal(size=(draws, blocks))
        gaps = map(student_interval, returns.tolist())
        numbers.append(_share(((gap.low, gap.high) for gap in gaps), 1.0))
    yield _target(f"difference (Student): 50 in 2 % of the blocks, {sizes}", *numbers)


def _of_verdicts(draws: int) -> Iterator[Target]:
    """Elo at the end of a sequential test."""
    settings = GateConfig(elo0=0, elo1=60, max_blocks=1000, nights=None)
    rng = np.random.default_rng(7)
    for elo in (0.0, 30.0, 60.0, 200.0):
        shares = stronger(EQUALS["decisive"], elo)
        truth, bounds = float(elo_of(float(shares @ CELLS))), list[Bounds]()
        for _ in range(draws):
            scores: list[float] = []
            while (decision := decide(settings, scores)).outcome is None:
                scores += CELLS[rng.choice(5, p=shares, size=100)].tolist()
            assert decision.estimate is not None
            bounds.append((decision.estimate.low, decision.estimate.high))
        yield _target(f"Elo of a verdict, after its sequential stop: {elo:+.0f} Elo", _share(iter(bounds), truth))


def _of_exploiters(draws: int) -> Iterator[Target]:
    """Lower bounds of exploitability, and differences over rounds, or over rounds and exploiters."""
    rng = np.random.default_rng(8)
    for chances in ((0.6,), (0.6, 0.6, 0.6), (0.97, 0.5, 0.5)):
        held = 0
        for _ in range(draws):
            matches = [
                match((f"x{i}", "v"), (float(first), float(second)))
                for i, chance in enumerate(chances)
                for first, second in rng.random((100, GAMES_PER_BLOCK)) < chance
            ]
            held += exploitability_bound("v", [f"x{i}" for i in range(len(chances))], matches).bound <= max(chances)
        scores = ", ".join(f"{chance:g}" for chance in chances)
        yield _target(f"exploitability (lower bound): exploiters that score {scores}", held / draws)
    for spread in (0.0, 0.03, 0.1):
        by_block, by_both = exploiter_gates.coverage(draws, spread)
        case = f"3 exploiters with a deviation of {spread:g}"
        if not spread:  # it claims to hold for these exploiters only
            yield _target(f"difference of exploitability over blocks: {case}", by_block)
        yield _target(f"difference of exploitability over blocks and exploiters: {case}", by_both)


POPULATIONS = {
    "equal": np.zeros((3, 3)),
    "50 Elo steps": np.array([[0.0, -50, -100], [50, 0, -50], [100, 50, 0]]),
    "a cycle": np.array([[0.0, 100, -100], [-100, 0, 100], [100, -100, 0]]),
    "a cycle of 60 and 120 Elo": np.array([[0.0, 60, -120], [-60, 0, 120], [120, -120, 0]]),
}
"""Elo of the row over the column."""
POPULATION_BLOCKS = (200, 16)


def _of_populations(draws: int) -> Iterator[Target]:
    """Shares of α-Rank and Nash averaging."""
    names = ["a", "b", "c"]
    for population_name, elos in POPULATIONS.items():
        shares = {(i, j): stronger(EQUALS["decisive"], elos[i, j], "logistic") for i, j in combinations(range(3), 2)}
        table = np.full((3, 3), 0.5)
        for (i, j), cells in shares.items():
            table[i, j] = cells @ CELLS
            table[j, i] = 1 - table[i, j]
        truths = {"α-Rank": alpha_rank(table), "Nash averaging": nash_averaging(2 * table - 1)[0]}
        held: dict[str, list[float]] = {kind: [] for kind in truths}
        for blocks in POPULATION_BLOCKS:
            rng = np.random.default_rng(9)
            estimates = [
                population(
                    names,
                    {
                        (names[i], names[j]): _pair_sums(rng.multinomial(blocks, cells))
                        for (i, j), cells in shares.items()
                    },
                )
                for _ in range(draws)
            ]
            of_kind = {
                "α-Rank": [estimate.alpha_rank for estimate in estimates if estimate],
                "Nash averaging": [estimate.nash for estimate in estimates if estimate],
            }
            for kind, of_draws in of_kind.items():
                held[kind].append(float(np.mean([[*map(_holds, parts, truths[kind])] for parts in of_draws])))
        for kind, numbers in held.items():
            sizes = f"{', '.join(map(str, POPULATION_BLOCKS))} blocks a pair"
            yield _target(f"shares of {kind}: {population_name}, {sizes}", *numbers)


def _pair_sums(counts: NDArray[np.int64]) -> PairSums:
    whole = GameSums()
    for cell, number in enumerate(counts.tolist()):
        if number:
            # Twice the scores: a cell is half a point more than the last.
            whole.count((cell, 2 * GAMES_PER_BLOCK - cell), GAMES_PER_BLOCK, None, number)
    return PairSums(int(counts.sum()), whole)


def _holds(estimate: Estimate, truth: float) -> bool:
    assert estimate.low is not None
    assert estimate.high is not None
    rounding = 1e-9
    return bool(estimate.low - rounding <= truth <= estimate.high + rounding)


def _of_runs(draws: int) -> Iterator[Target]:
    """The IQM and the probability of improvement. Scores are uniform around a mean of each task."""
    for runs, tasks in ((40, 5), (5, 5), (3, 1)):
        rng = np.random.default_rng(10)
        truth = iqm(_scores(rng, 2_000_000, tasks))
        # P(X + 0.1 > Y) for uniform X and Y is 1 - (1 - 0.1)² / 2.
        improvement = 1 - 0.9**2 / 2
        held = np.zeros(2)
        for number in range(draws):
            ours, theirs = _scores(rng, runs, tasks), _scores(rng, runs, tasks)
            of_iqm = stratified_bootstrap(iqm, ours, resamples=RESAMPLES, seed=number)
            of_both = stratified_bootstrap(
                probability_of_improvement, ours + 0.1, theirs, resamples=RESAMPLES, seed=number
            )
            held += of_iqm.low <= truth <= of_iqm.high, of_both.low <= improvement <= of_both.high
        case = f"{runs} runs of {tasks} {'tasks' if tasks > 1 else 'task'}"
        for name, number in zip(("IQM", "probability of improvement"), held, strict=True):
            yield _target(f"{name}: {case}", float(number) / draws)


def _scores(rng: np.random.Generator, runs: int, tasks: int) -> Floats:
    return np.asarray(rng.random((runs, tasks)) + np.linspace(0, 0.4, tasks))


def _of_teams(draws: int) -> Iterator[Target]:
    """Cross-play: a cell, the mean of the diagonal, and that of the other cells. Returns are normal."""
    names, numbers = ["a", "b", "c"], (32, 8, 3)
    held = []
    for matches in numbers:
        rng, tables = np.random.default_rng(11), []
        for _ in range(draws):
            pairs = [*combinations(names, 2), *((name, name) for name in names)]
            played = [_team_match(pair, rng.normal(size=GAMES_PER_BLOCK)) for pair in pairs for _ in range(matches)]
            table = cross_play_table(names, played)
            cells = [_holds(cell, 0.0) for row in table.returns for cell in row if cell is not None]
            diagonal, mixed = (_holds(estimate, 0.0) for estimate in (table.own, table.mixed) if estimate is not None)
            tables.append((np.mean(cells), diagonal, mixed))
        held.append(np.mean(tables, axis=0))
    for name, shares in zip(("cell", "own", "mixed"), np.transpose(held).tolist(), strict=True):
        yield _target(f"cross-play, {name}: {', '.join(map(str, numbers))} matches a pair", *shares)


def _team_match(contestants: tuple[str, str], returns: Floats) -> Match:
    games = tuple(
        Game((i, 1 - i), 0, (), (), returns=(float(value), float(value)), scores=(None, None))
        for i, value in enumerate(returns)
    )
    return Match("", "", "", 0, contestants, 0, "", games)
