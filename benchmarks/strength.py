"""How strong is a version? Greedy, with random openings, on both sides equally, against scripts or other versions.

Plays the champion of connect_four in LEAGUE_HOME, or the given version. A draw is not a win. The bound is the lower
limit of Wilson's two-sided 95 % interval of the fraction of wins. Nothing is written to the ledger.
"""

import argparse
import sys

from scipy.stats import binomtest

from evaluation.matches.worker import MatchWorker
from evaluation.schedules.builders import round_robin
from league.errors import LeagueError
from league.policies.loading import baselines, pinned
from league.refs import CheckpointRef
from league.registry.registry import Registry

TARGETS = {
    "script:random": {"demo": 0.95, "full": 0.98},
    "script:one_ply": {"demo": 0.85, "full": 0.97},
    "script:mcts_100": {"full": 0.60},
}
"""opponent → configuration → target of the lower bound"""


def main() -> int:
    """Print fractions and bounds with their targets; 1 if a requested one is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("ref", nargs="?", default="connect_four@champion", help="default: %(default)s")
    parser.add_argument("--against", nargs="+", metavar="REF", help="default: random and one_ply; script:mcts_100, …")
    parser.add_argument("--games", type=int, default=2000, help="against each opponent; default: %(default)s")
    parser.add_argument("--quick", action="store_true", help="a tenth of the games")
    parser.add_argument("--hold", choices=("demo", "full"), default="demo", help="which targets must be met")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    games = max(2, options.games // 10 if options.quick else options.games)
    try:
        return int(not _measure(options.ref, options.against, games, options.seed, options.hold))
    except LeagueError as error:
        print(error, file=sys.stderr)
        return 2


def _measure(ref: str, against: list[str] | None, games: int, seed: int, target_set: str) -> bool:
    registry = Registry.open()
    league = CheckpointRef.parse(ref).league
    row = registry.leagues.get(league)
    version = pinned(ref, league, registry)
    player = MatchWorker(row.config, registry)
    print(f"{version}, greedy, {games} games each, {row.config.play.opening_plies} random opening plies")
    met = True
    for opponent in against or baselines(row.config, row.interface):
        schedule = round_robin(row.config, row.interface, [version, opponent], games // 2, seed)
        points = [game.scores[0] for match in player.play(schedule, range(schedule.length)) for game in match.games]
        met &= _report(opponent, points, target_set)
    return met


def _report(opponent: str, points: list[float], target_set: str) -> bool:
    won, drawn = points.count(1.0), points.count(0.5)
    low = binomtest(won, len(points)).proportion_ci(0.95, "wilson").low
    print(
        f"against {opponent}: won {won / len(points):.2%} ({won} won, {drawn} drawn, {points.count(0.0)} lost),"
        f" lower 95 % bound {low:.2%}; score {(won + drawn / 2) / len(points):.2%}"
    )
    targets = TARGETS.get(opponent, {})
    for configuration, target in targets.items():
        verdict = "met" if low >= target else "missed"
        print(f"  bound / target of the {configuration} configuration ({target:.0%}): {low / target:.3f}, {verdict}")
    target = targets.get(target_set)
    return target is None or low >= target


if __name__ == "__main__":
    sys.exit(main())
