"""Do ten nights of `league nightly --train` make a league stronger, and not easier to exploit?

Each night is one call of the command in a league of its own; a night trains for three minutes, and its exploiter for
the configured share of that, by default 15 %. In the end, the last champion plays the first one. Exploitability has
risen if the interval of the last champion's exploiter is above that of the first champion's: of its score, or of its
gain in returns if the gate tests returns. If `benchmarks.exploitability` knows the game, the exact exploitability of
all candidates is printed as well.

    python -m benchmarks.training_nights connect_four leduc_holdem
    python -m benchmarks.training_nights tictactoe --nights 2 --minutes 0.2
    python -m benchmarks.training_nights leduc_holdem --steps 6_000_000
    python -m benchmarks.training_nights leduc_holdem --nights 3 --league-share 0.5

`--steps` limits nights by actions instead of time. On a machine with other work, exploiters get equal training then.
`--league-share` sets how much of a night is played against versions of the league.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import yaml

from benchmarks.exploitability import MEASUREMENTS
from benchmarks.training.learned import report_target
from evaluation.matches.worker import MatchWorker
from evaluation.schedules.builders import round_robin
from evaluation.statistics.payoff import paired_difference, score_interval
from league.config.league import LeagueConfig
from league.policies.loading import eligible, load
from league.registry.registry import Registry
from league.settings import Storage
from policy_league.cli.output import difference
from policy_league.configs.bundled import find

NIGHTS, MINUTES = 10, 3.0
SCORE = 0.75
"""What the last champion must score against the first."""
BLOCKS = {"score": 200, "gain": 10_000}
"""Matches of the last champion against the first, by what is compared."""


def main() -> int:
    """Print all nights; 1 if a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("configs", nargs="*", metavar="CONFIG", default=["connect_four"], help="default: %(default)s")
    parser.add_argument("--nights", type=int, default=NIGHTS)
    parser.add_argument("--minutes", type=float, default=MINUTES, help="training time of a night; default: %(default)g")
    parser.add_argument("--steps", type=int, help="actions of a night, instead of --minutes")
    parser.add_argument(
        "--league-share",
        type=float,
        metavar="SHARE",
        help="share of the episodes against opponents from the league, 0 for none; default: the configuration's",
    )
    parser.add_argument("--quick", action="store_true", help="smoke test: two nights of 0.2 minutes")
    options = parser.parse_args()
    nights, minutes = (2, 0.2) if options.quick else (options.nights, options.minutes)
    settings: dict[str, Any] = {"minutes": minutes} if options.steps is None else {"steps": options.steps}
    if options.league_share is not None:
        settings["opponents"] = {"league": {"share": options.league_share}} if options.league_share else None
    met = True
    for name in options.configs:
        with tempfile.TemporaryDirectory() as home:
            met &= measure(_configure(name, settings, Path(home)), Path(home), nights)
    return int(not met)


def _configure(name: str, settings: dict[str, Any], home: Path) -> Path:
    """Write a bundled configuration with these settings of a night; return its path."""
    document = yaml.safe_load(find(name).read_text())
    document["nightly"] = document.get("nightly", {}) | settings
    path = home / f"{document['league']}.yaml"
    path.write_text(yaml.safe_dump(document))
    return path


def measure(config: Path, home: Path, count: int) -> bool:
    """Run the nights and print them; return whether the targets are met."""
    nights, compared = [], _compared(config)
    for _ in range(count):
        nights.append(run_night(config, home))
        print(_line(nights[-1], compared), flush=True)
    verdicts = [verdict for night in nights for verdict in night["steps"]["gate"]["verdicts"]]
    champions = [verdict["candidate"] for verdict in verdicts if verdict["outcome"] == "promote"]
    measured = [found for night in nights if (found := night["steps"]["measure"]["exploitability"])]
    if not champions or not measured:
        return report_target(f"{config.stem}: no champion with an exploiter", "one", False)
    first, last = (_of_exploiter(found, compared) for found in (measured[0], measured[-1]))
    stays = report_target(
        f"{config.stem}, {compared} of the champion's exploiter: {_interval(first)} first, {_interval(last)} last",
        "not risen",
        last[1] <= first[2],
    )
    if (known := MEASUREMENTS.get(config.stem)) is not None:
        stays &= _is_exactly_less(config.stem, home, known.exploitability, champions)
    return _is_stronger(config.stem, home, champions[-1], champions[0], compared) and stays


def _compared(config: Path) -> str:
    """What an exploiter's success is measured by: `gain` in returns if the gate tests returns, else `score`."""
    return "gain" if LeagueConfig.load(config).gate.model == "returns" else "score"


def _of_exploiter(found: dict[str, Any], compared: str) -> tuple[float, float, float]:
    """The mean score or gain of the best exploiter by its lower bound, and its interval."""
    name, results = "score", found["exploiters"]
    if compared == "gain":
        name, results = "mean", [each["gain"] for each in results]
    best = max(results, key=lambda each: each["low"])
    return best[name], best["low"], best["high"]


def _interval(found: tuple[float, float, float]) -> str:
    return f"{found[0]:.3f} [{found[1]:.3f}, {found[2]:.3f}]"


def run_night(config: Path, home: Path) -> dict[str, Any]:
    """Run `league nightly --train`. Raises CalledProcessError if it reports a fault."""
    command = [
        sys.executable,
        "-c",
        "from policy_league.cli.main import run; run()",
        "nightly",
        str(config),
        "--train",
        "--json",
    ]
    environment = os.environ | {"LEAGUE_HOME": str(home)}
    document = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True).stdout
    night: dict[str, Any] = json.loads(document)["nights"][0]
    return night


def _line(night: dict[str, Any], compared: str) -> str:
    gate, found = night["steps"]["gate"], night["steps"]["measure"]["exploitability"]
    before = gate["champion_before"]
    promoted = [verdict["candidate"] for verdict in gate["verdicts"] if verdict["outcome"] == "promote"]
    change = f"before: {before or 'none'}; promoted: {', '.join(promoted)}" if promoted else "unchanged"
    trained = len(night["steps"]["train"]["versions"])
    exploited = f"{compared} of its exploiter: {_interval(_of_exploiter(found, compared))}" if found else "no exploiter"
    return (
        f"{night['league']}, night {night['night']}: {trained} versions, champion {gate['champion']} ({change});"
        f" {exploited}"
    )


def _is_exactly_less(league: str, home: Path, exploitability: Callable[[Any], float], champions: list[str]) -> bool:
    """Print the exact exploitability of all candidates, and compare that of the last champion with the first's."""
    with closing(Registry.open(Storage.at(home))) as registry:
        exact = {each.ref: exploitability(load(each.ref, registry=registry)) for each in eligible(registry, league)}
    print("exact exploitability: " + ", ".join(f"{ref} {value:.3f}" for ref, value in exact.items()), flush=True)
    first, last = exact[champions[0]], exact[champions[-1]]
    return report_target(
        f"{league}, exact exploitability of the champion: {first:.3f} at first, {last:.3f} at last",
        "not risen",
        last <= first,
    )


def _is_stronger(league: str, home: Path, last: str, first: str, compared: str) -> bool:
    """Play the last champion against the first, without recording the matches."""
    if last == first:
        return report_target(f"{league}: {first} is still the champion", f"{SCORE:.0%} against the first", False)
    with closing(Registry.open(Storage.at(home))) as registry:
        row = registry.leagues.get(league)
        schedule = round_robin(row.config, row.interface, [last, first], BLOCKS[compared])
        matches = MatchWorker(row.config, registry).play(schedule, range(schedule.length))
    score, low, high = score_interval([match.score(0) for match in matches])
    if compared == "gain" and (gain := paired_difference(matches, last)) is not None:
        print(f"{league}: {last} gains {difference(gain)} per game against {first}", flush=True)
    return report_target(
        f"{league}: {last} scores {score:.1%} [{low:.1%}, {high:.1%}] against {first}", f"{SCORE:.0%}", score >= SCORE
    )


if __name__ == "__main__":
    sys.exit(main())
