"""How fast are matches played, and do more workers help?

Connect four, on one core unless workers are compared.

Parts: throughput (in CPU time, from the schedule to the Match records, with ONNX policies on both sides: MLPs of 2×256
and the convolutional networks of the bundled connect_four; compared with the unmodified `env()` with random legal
moves and without networks, and with the unmodified `env()` whose moves are computed by the same networks as RLModules,
`forward_inference` for each single move), verdict (4,000 games with MLPs of 2×256: schedule, games, sequential test,
ledger, gate result and report; in wall and in CPU time), workers (a tournament, including the ledger, with two Ray
workers and with one, in wall time). Compared measurements alternate within a round; a rate is the median over the
rounds. Networks are untrained, which does not change their inference time.
"""

import itertools
import logging
import random
import statistics
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pettingzoo.classic import connect_four_v3
from ray.rllib.core.columns import Columns

from benchmarks.harness import Parts, Quick, Target, chosen, in_rounds, rate
from benchmarks.leagues.evaluated_league import CONFIG, publish, with_mlp
from benchmarks.stock import moves
from benchmarks.tournaments import adaptive_ranking, rating_speed, tournament_kills
from benchmarks.training.learned import local_ray
from evaluation.gating.verdicts import conclude, open_verdict
from evaluation.matches.tournament import play_schedule
from evaluation.matches.worker import MatchWorker
from evaluation.schedules.builders import round_robin
from league.config.league import LeagueConfig
from league.refs import CHAMPION
from league.registry.registry import Registry
from league.results.records import Schedule
from league.spaces import ACTION_MASK
from training.modules.actor_critic import ActorCritic

VERSIONS = [f"{CONFIG.league}@{number}" for number in (1, 2)]
MLP = with_mlp(CONFIG)
VERDICT_BLOCKS = 2000
VERDICT_SECONDS = 0.5
"""Most seconds for a verdict of so many blocks of two games."""


def throughput(quick: bool) -> Iterator[Target]:
    """With MLPs at least 12 times the unmodified environment; 3 times the loop with a forward pass for each move."""
    yield from _throughput("MLP 2×256", MLP, quick, 12.0)
    yield from _throughput("convolutional", CONFIG, quick, None)


def _throughput(name: str, config: LeagueConfig, quick: bool, target: float | None) -> Iterator[Target]:
    seconds, rounds = (0.7, 3) if quick else (2.0, 9)
    with tempfile.TemporaryDirectory() as home:
        registry, modules = publish(Path(home), 2, config)
        worker, schedules = MatchWorker(config, registry), _schedules(registry, blocks=1024)
        stock, networks = connect_four_v3.env(), connect_four_v3.env()
        plays: dict[str, Callable[[], int]] = {
            "ours": lambda: _play(worker, next(schedules)),
            "stock": lambda: sum(1 for _ in moves(stock, _at_random)),
            "forward": lambda: sum(1 for _ in moves(networks, _by_network(modules))),
        }
        measures = {key: partial(rate, play, seconds, time.process_time) for key, play in plays.items()}
        in_rounds(measures, 1)  # a warm-up
        rates = in_rounds(measures, rounds)
        registry.close()
    for key, peer, least in (("stock", "the stock environment", target), ("forward", "a forward pass per move", 3.0)):
        note = f"{rates['ours']:,.0f} to {rates[key]:,.0f} moves/s"
        yield Target(name, rates["ours"] / rates[key], "×", at_least=least, peer=peer, note=note)


def verdict(quick: bool) -> Iterator[Target]:
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
    name = f"processor time of a verdict of {2 * VERDICT_BLOCKS:,} games"
    yield Target(name, round(cpu, 3), "s", at_most=VERDICT_SECONDS, note=f"{wall:.3f} s in all")


def _verdict_times(registry: Registry, config: LeagueConfig) -> tuple[float, float]:
    """Wall and CPU seconds of one verdict."""
    began = time.perf_counter(), time.process_time()
    opened = open_verdict(registry, registry.leagues.get(config.league), 2, VERSIONS[0])
    report = conclude(registry, opened)
    ended = time.perf_counter(), time.process_time()
    assert (report.outcome, report.blocks) == ("inconclusive", VERDICT_BLOCKS)
    return ended[0] - began[0], ended[1] - began[1]


def workers(quick: bool) -> Iterator[Target]:
    """Two workers play at least 1.7 times as fast as one."""
    blocks, rounds = (1024, 1) if quick else (4096, 5)
    with tempfile.TemporaryDirectory() as home:
        registry, _ = publish(Path(home), 2)
        first, schedules = _schedules(registry, 256), _schedules(registry, blocks)

        def measure(count: int) -> float:
            """Games per second with this number of workers, in a Ray with one CPU for each."""
            with local_ray(cpus=count):
                _tournament(next(first), registry, count)  # workers start and load their modules
                return _tournament(next(schedules), registry, count)

        rates = in_rounds({count: partial(measure, count) for count in (1, 2)}, rounds)
        registry.close()
    yield Target("two workers", rates[2] / rates[1], "×", at_least=1.7, peer="one")


def _schedules(registry: Registry, blocks: int) -> Any:
    """Successive schedules with different games."""
    row = registry.leagues.get(CONFIG.league)
    return (round_robin(row.config, row.interface, VERSIONS, blocks, seed) for seed in itertools.count())


def _play(worker: MatchWorker, schedule: Schedule) -> int:
    """Play a complete schedule; returns the number of moves."""
    matches = worker.play(schedule, range(schedule.length))
    return sum(len(game.opening) + len(game.actions) for match in matches for game in match.games)


def _tournament(schedule: Schedule, registry: Registry, count: int) -> float:
    """Games per second."""
    began = time.perf_counter()
    matches = play_schedule(schedule, registry=registry, workers=count)
    return sum(len(match.games) for match in matches) / (time.perf_counter() - began)


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


PARTS: dict[str, Callable[[bool], Iterator[Target]]] = {
    "throughput": throughput,
    "verdict": verdict,
    "workers": workers,
    "ratings": rating_speed.run,
    "adaptive": adaptive_ranking.run,
    "kills": tournament_kills.run,
}


def main(parts: Parts = None, quick: Quick = False) -> Iterator[Target]:
    """Measure the parts."""
    logging.disable(logging.WARNING)
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    for part in chosen(parts, PARTS).values():
        yield from part(quick)
