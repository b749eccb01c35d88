"""How strong is a version?

Greedy, with random openings, on both sides equally, against scripts or other versions.

Plays the champion of connect_four in LEAGUE_HOME, or the given version. A draw is not a win. The bound is the lower
limit of Wilson's two-sided 95 % interval of the fraction of wins. Nothing is written to the ledger.
"""

from collections import Counter
from collections.abc import Iterator
from enum import StrEnum
from typing import Annotated

import typer

from benchmarks.harness import Quick, Target
from benchmarks.training.matches import lower_bound
from evaluation.matches.worker import MatchWorker
from evaluation.schedules.builders import round_robin
from league.policies.loading import baselines, pinned
from league.refs import CheckpointRef
from league.registry.registry import Registry

TARGETS = {
    "demo": {"script:random": 95.0, "script:one_ply": 85.0},
    "full": {"script:random": 98.0, "script:one_ply": 97.0, "script:mcts_100": 60.0},
}
"""Configuration → opponent → target of the lower bound, in percent."""


class Configuration(StrEnum):
    """Which targets must be met: those of `make demo`, or of the whole training."""

    DEMO = "demo"
    FULL = "full"


def main(
    ref: Annotated[str, typer.Argument()] = "connect_four@champion",
    quick: Quick = False,
    against: Annotated[list[str] | None, typer.Option(help="default: random and one_ply; script:mcts_100, …")] = None,
    games: Annotated[int, typer.Option(help="against each opponent")] = 2000,
    hold: Configuration = Configuration.DEMO,
    seed: int = 0,
) -> Iterator[Target]:
    """Play against each opponent."""
    games = max(2, games // 10 if quick else games)
    registry = Registry.open()
    league = CheckpointRef.parse(ref).league
    row, version = registry.leagues.get(league), pinned(ref, league, registry)
    player = MatchWorker(row.config, registry)
    print(f"{version}, greedy, {games} games each, {row.config.play.opening_plies} random opening plies")
    for opponent in against or baselines(row.config, row.interface):
        schedule = round_robin(row.config, row.interface, [version, opponent], games // 2, seed)
        played = [game for match in player.play(schedule, range(schedule.length)) for game in match.games]
        counts = Counter(game.scores[0] for game in played)
        note = f"{counts[1]} won, {counts[0.5]} drawn, {counts[0]} lost"
        limit = TARGETS[hold].get(opponent)
        yield Target(
            f"{hold} against {opponent}, lower bound", round(lower_bound(played), 2), "%", at_least=limit, note=note
        )
