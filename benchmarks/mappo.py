"""MAPPO compared with independent PPO in cooperative games: does a central critic help?

Both have the same settings except `critic`, and the same number of actions. A cell is the training of one game with one
critic and one seed, on one core. Its result is appended to a JSON file, and it is not measured again, so that the
measurement can be interrupted and continued. Returns are per agent and episode, with greedy policies in new episodes.
"""

import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from scipy import stats

from benchmarks.harness import CONFIGS, ROOT, Parts, Quick, Target, chosen
from benchmarks.training.learned import in_processes, learn, local_ray, one_thread
from league.config.league import LeagueConfig
from league.files import replacing

CELLS = Path(__file__).parent / "cells" / "mappo.json"
GAMES = {
    "simple_spread": ("mpe2.simple_spread_v3", {"shared": ["agent_*"]}),
    "simple_speaker_listener": (
        "mpe2.simple_speaker_listener_v4",
        {"speaker": ["speaker_*"], "listener": ["listener_*"]},
    ),
    "simple_reference": ("mpe2.simple_reference_v3", {"shared": ["agent_*"]}),
}
"""Game → entry point, and policies."""
CRITICS = {"MAPPO": "central", "PPO": "own"}
EPISODES = 400


@dataclass(frozen=True, slots=True)
class Cell:
    """One training."""

    game: str
    critic: str
    seed: int
    steps: int


@dataclass(frozen=True, slots=True)
class CellResult:
    """Mean greedy and random returns, and the processor time of everything in seconds."""

    cell: Cell
    greedy: float
    random: float
    seconds: float


def read(file: Path) -> dict[Cell, CellResult]:
    """Return the results in a file, which may not exist yet."""
    rows = json.loads(file.read_text()) if file.exists() else []
    results = [CellResult(**row | {"cell": Cell(**row["cell"])}) for row in rows]
    return {result.cell: result for result in results}


def append(result: CellResult, file: Path) -> None:
    """Add a result to a file."""
    file.parent.mkdir(parents=True, exist_ok=True)
    results = [*read(file).values(), result]
    with replacing(file) as draft:
        draft.write_text("[\n" + ",\n".join(json.dumps(asdict(row)) for row in results) + "\n]\n")


def league_of(cell: Cell) -> LeagueConfig:
    """Return simple_spread's configuration for a game, sampling in the learner's process."""
    entry_point, policies = GAMES[cell.game]
    league = LeagueConfig.load(CONFIGS / "simple_spread.yaml").model_dump(by_alias=True)
    changes = {
        "league": cell.game,
        "environment": {"entry_point": entry_point},
        "policies": policies,
        "play": {},
    }
    return LeagueConfig.from_mapping(league | changes).with_training(
        critic=cell.critic, normalize_values=True, seed=cell.seed, runners=0
    )


def work(cell: Cell) -> CellResult:
    """Learn on the single core of this process."""
    one_thread()
    began = time.process_time()
    with local_ray(cpus=1):
        learned = learn(league_of(cell), steps=cell.steps, episodes=EPISODES)
    seconds = time.process_time() - began
    return CellResult(cell, float(learned.greedy.mean()), float(learned.random.mean()), round(seconds, 1))


def difference(first: NDArray, second: NDArray) -> tuple[float, float, float]:
    """Return the difference of two interquartile means over seeds, with its 95 % percentile bootstrap interval.

    Agarwal et al., 2021, "Deep reinforcement learning at the edge of the statistical precipice", arXiv 2108.13264.
    """

    def statistic(one: NDArray, other: NDArray, axis: int = -1) -> NDArray:
        return stats.trim_mean(one, 0.25, axis) - stats.trim_mean(other, 0.25, axis)

    drawn = stats.bootstrap((first, second), statistic, method="percentile", rng=np.random.default_rng(0))
    low, high = drawn.confidence_interval
    return float(statistic(first, second)), float(low), float(high)


def main(
    parts: Parts = None,
    quick: Quick = False,
    steps: Annotated[int, typer.Option(help="actions of each cell")] = 1_000_000,
    seeds: Annotated[int, typer.Option(min=2, help="of each game and critic")] = 5,
    cells: Annotated[int | None, typer.Option(help="number of cells to measure now; by default all")] = None,
    file: Annotated[Path, typer.Option(help="of the results of cells")] = CELLS,
) -> Iterator[Target]:
    """Measure missing cells, and compare the critics in each game whose cells are complete."""
    if quick:
        steps, seeds, file = 20_000, 2, ROOT / "build/benchmarks/mappo.json"
    games = chosen(parts, GAMES)
    # The two critics of a seed follow each other, so that an interrupted measurement has pairs.
    plan = [Cell(game, critic, seed, steps) for game in games for seed in range(seeds) for critic in CRITICS.values()]
    missing = [cell for cell in plan if cell not in read(file)]
    for result in in_processes(work, missing[:cells]):
        append(result, file)
        print(f"{result.cell}: {result.greedy:.2f}, random {result.random:.2f}, {result.seconds:,.0f} s", flush=True)
    results = read(file)
    for game in games:
        if all(cell in results for cell in plan if cell.game == game):
            yield compare(game, [results[cell] for cell in plan if cell.game == game])


def compare(game: str, results: Sequence[CellResult]) -> Target:
    """Return the lower bound of what a central critic gains in a game."""
    returns = {
        name: np.array([result.greedy for result in results if result.cell.critic == critic])
        for name, critic in CRITICS.items()
    }
    gained, low, high = difference(*returns.values())
    listed = "; ".join(f"{name} {', '.join(f'{value:.2f}' for value in values)}" for name, values in returns.items())
    note = f"{gained:+.2f}, at most {high:+.2f}; {listed}"
    return Target(f"{game}, gain of a central critic, lower bound", round(low, 2), at_least=0.0, peer="PPO", note=note)
