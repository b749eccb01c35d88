"""How much stronger is a version of connect four with a search?

Plays the champion of connect_four in LEAGUE_HOME, or the given version, with a search against itself without one
(part itself) and against scripts (minimax, mcts): greedy, from random openings of four plies, on both sides equally. A
score counts a draw as half a win; bounds are the lower limits of 95 % intervals over matches of two games. Against
`mcts_1000`, the number of simulations is that of the same processor time per move, measured before in single positions.
late_positions are those of `decisive_positions`; tictactoe plays games of the champion of tictactoe against perfect
play, from the empty board. Nothing is written to the ledger.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from statistics import fmean, stdev
from time import process_time
from typing import Annotated

import numpy as np
import typer
from scipy.stats import binomtest

from benchmarks.decisive_positions import POSITIONS, decisive_positions
from benchmarks.harness import Parts, Quick, Target, chosen
from benchmarks.search import positions
from evaluation.matches.worker import MatchWorker
from evaluation.schedules.builders import round_robin
from evaluation.statistics.sequential import elo_of
from league.environments.vector.connect_four import ConnectFour
from league.policies.loading import load
from league.policies.policy import Policy
from league.policies.scripted import script
from league.refs import CheckpointRef
from league.registry.registry import Registry
from league.registry.storage.manifest import SearchRule
from league.search.policies import SearchPolicy, search_policies

GAMES, OPENING_PLIES, SIMULATIONS = 1000, 4, 100
ELO, AGAINST_MINIMAX, AGAINST_MCTS = 220, 93.0, 60.0
LATE_SIMULATIONS, KEPT, KEPT_LOW = 200, 97.5, 96.0
TICTACTOE_GAMES, TICTACTOE_SIMULATIONS = 10_000, 50
TIMED = 40
"""Positions of which each takes one search when times are measured."""
SEED = 0


class Arena:
    """Matches of a version with a search. opening_plies: random moves at the start."""

    def __init__(self, ref: str, registry: Registry, rule: SearchRule, opening_plies: int = OPENING_PLIES) -> None:
        self._rule, self._registry, self._base = rule, registry, registry.versions.resolve(CheckpointRef.parse(ref))
        row = registry.leagues.get(self._base.league)
        play = row.config.play.model_copy(update={"opening_plies": opening_plies})
        self._config, self.interface = row.config.model_copy(update={"play": play}), row.interface
        self._worker = MatchWorker(self._config, registry)

    @property
    def base(self) -> str:
        """The version without a search."""
        return self._base.ref

    @property
    def described(self) -> str:
        """How long the version was trained."""
        return f"{self._base.steps:,} steps"

    def search(self, simulations: int) -> Mapping[str, SearchPolicy]:
        """The policies of the version with a search, by id."""
        environment = self._config.environment
        return search_policies(self._base, self._rule, simulations, self._registry, self.interface, environment)

    def scores(self, simulations: int, opponent: str, games: int) -> list[float]:
        """Mean score of the version with a search in each match against an opponent."""
        policies = self.search(simulations)
        guest = {agent: (policy, policies[policy]) for agent, policy in self.interface.policies.items()}
        schedule = round_robin(self._config, self.interface, ["search", opponent], games // 2, SEED)
        matches = self._worker.play(schedule, range(schedule.length), guests={"search": guest})
        return [match.score(match.contestants.index("search")) for match in matches]

    def score(self, simulations: int, opponent: str, games: int) -> tuple[float, float]:
        """Mean score of the version with a search against an opponent, and its lower bound."""
        scores = self.scores(simulations, opponent, games)
        return fmean(scores), fmean(scores) - 1.96 * stdev(scores) / len(scores) ** 0.5


def milliseconds(policy: Policy) -> float:
    """Mean processor time of a move in single positions after six plies."""
    (rows,) = positions(ConnectFour(TIMED), np.arange(TIMED))
    began = process_time()
    for row in range(TIMED):
        observation = {name: array[row : row + 1] for name, array in rows.observations.items()}
        policy.act(observation, rng=[np.random.default_rng([SEED, row])])
    return 1000 * (process_time() - began) / TIMED


@dataclass(frozen=True, slots=True)
class Setting:
    """What the parts measure. scale: divides the numbers of games and positions."""

    registry: Registry
    rule: SearchRule
    ref: str
    small: str
    scale: int

    def arena(self) -> Arena:
        """Matches of the version of connect four."""
        return Arena(self.ref, self.registry, self.rule)


def itself(setting: Setting) -> Iterator[Target]:
    """Against the version without a search."""
    arena, games = setting.arena(), GAMES // setting.scale
    score, low = arena.score(SIMULATIONS, arena.base, games)
    note = f"{arena.described}, {SIMULATIONS} simulations, {games} games, score {score:.1%}"
    yield Target(f"{setting.rule}: Elo, lower bound", round(elo_of(low)), "Elo", at_least=ELO, peer="itself", note=note)


def minimax(setting: Setting) -> Iterator[Target]:
    """Against `minimax_4`."""
    yield _against("minimax_4", setting, SIMULATIONS, "", AGAINST_MINIMAX)


def mcts(setting: Setting) -> Iterator[Target]:
    """Against `mcts_1000`, at equal processor time per move."""
    arena = setting.arena()
    spaces = arena.interface.of_policy(arena.interface.policy_ids[0])
    allowed = milliseconds(script("mcts_1000", spaces.observation, spaces.action))
    few, many = (milliseconds(next(iter(arena.search(count).values()))) for count in (SIMULATIONS, 4 * SIMULATIONS))
    simulations = round(SIMULATIONS + 3 * SIMULATIONS * (allowed - few) / (many - few))
    yield _against("mcts_1000", setting, simulations, f" in {allowed:.1f} ms", AGAINST_MCTS)


def _against(opponent: str, setting: Setting, simulations: int, time: str, at_least: float) -> Target:
    arena, games = setting.arena(), GAMES // setting.scale
    score, low = arena.score(simulations, f"script:{opponent}", games)
    note = f"{arena.described}, {simulations} simulations{time}, {games} games, score {score:.1%}"
    name = f"{setting.rule}: score, lower bound"
    return Target(name, round(100 * low, 2), "%", at_least=at_least, peer=opponent, note=note)


def late_positions(setting: Setting) -> Iterator[Target]:
    """In the positions of `decisive_positions`."""
    arena, number = setting.arena(), POSITIONS // setting.scale
    spaces = arena.interface.of_policy(arena.interface.policy_ids[0])
    late = decisive_positions(number, script("one_ply", spaces.observation, spaces.action))
    kept = late.kept(next(iter(arena.search(LATE_SIMULATIONS).values())))
    bound = binomtest(int(kept.sum()), number).proportion_ci(0.95, "wilson").low
    plain = late.kept(load(arena.base, registry=setting.registry)).mean()
    note = f"{arena.described}, {LATE_SIMULATIONS} simulations, {number} positions; {plain:.1%} without a search"
    name = f"{setting.rule}: late outcomes kept"
    yield Target(name, round(100 * kept.mean(), 2), "%", at_least=KEPT, note=note)
    yield Target(f"{name}, lower bound", round(100 * bound, 2), "%", at_least=KEPT_LOW, note=note)


def tictactoe(setting: Setting) -> Iterator[Target]:
    """Tic-tac-toe from the empty board, against perfect play."""
    games = TICTACTOE_GAMES // setting.scale
    arena = Arena(setting.small, setting.registry, setting.rule, opening_plies=0)
    scores = arena.scores(TICTACTOE_SIMULATIONS, "script:solver", games)
    note = f"{arena.described}, {TICTACTOE_SIMULATIONS} simulations, {games} games"
    lost = sum(score < 0.5 for score in scores)
    yield Target(f"{setting.rule}: tic-tac-toe losses", lost, at_most=0, peer="the solver", note=note)


PARTS: dict[str, Callable[[Setting], Iterator[Target]]] = {
    "itself": itself,
    "minimax": minimax,
    "mcts": mcts,
    "late_positions": late_positions,
    "tictactoe": tictactoe,
}


def main(
    parts: Parts = None,
    quick: Quick = False,
    rule: SearchRule = "puct",
    ref: Annotated[str, typer.Option(help="the version of connect four")] = "connect_four@champion",
    small: Annotated[str, typer.Option(help="the version of tic-tac-toe")] = "tictactoe@champion",
) -> Iterator[Target]:
    """Play, solve and count."""
    setting = Setting(Registry.open(), rule, ref, small, 10 if quick else 1)
    for part in chosen(parts, PARTS).values():
        yield from part(setting)
