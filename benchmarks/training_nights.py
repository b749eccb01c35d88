"""Do ten nights of `league nightly --train` make a league stronger, and not easier to exploit?

Each night is one call of the command in a league of its own; a night trains for three minutes, and its exploiter for
15 % of that. In the end, the last champion plays the first one. Exploitability has risen if the interval of the last
champion's exploiter is above that of the first champion's. If `benchmarks.exploitability` knows the game, the exact
exploitability of all candidates is printed as well.

    python -m benchmarks.training_nights connect_four leduc_holdem
    python -m benchmarks.training_nights tictactoe --nights 2 --minutes 0.2
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
from configs import find
from evaluation.matches.worker import MatchWorker
from evaluation.schedules.builders import round_robin
from evaluation.statistics.payoff import score_interval
from league.policies.loading import eligible, load
from league.registry.registry import Registry
from league.settings import Storage

NIGHTS, MINUTES = 10, 3.0
SCORE = 0.75
"""What the last champion must score against the first."""
BLOCKS = 200


def main() -> int:
    """Print all nights; 1 if a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("configs", nargs="*", metavar="CONFIG", default=["connect_four"], help="default: %(default)s")
    parser.add_argument("--nights", type=int, default=NIGHTS)
    parser.add_argument("--minutes", type=float, default=MINUTES, help="training time of a night; default: %(default)g")
    parser.add_argument("--quick", action="store_true", help="smoke test: two nights of 0.2 minutes")
    options = parser.parse_args()
    nights, minutes = (2, 0.2) if options.quick else (options.nights, options.minutes)
    met = True
    for name in options.configs:
        with tempfile.TemporaryDirectory() as home:
            met &= measure(_short_nights(name, minutes, Path(home)), Path(home), nights)
    return int(not met)


def _short_nights(name: str, minutes: float, home: Path) -> Path:
    """Write a bundled configuration with this training time of a night; return its path."""
    document = yaml.safe_load(find(name).read_text())
    document["nightly"] = document.get("nightly", {}) | {"minutes": minutes}
    path = home / f"{document['league']}.yaml"
    path.write_text(yaml.safe_dump(document))
    return path


def measure(config: Path, home: Path, count: int) -> bool:
    """Run the nights and print them; return whether the targets are met."""
    nights = []
    for _ in range(count):
        nights.append(run_night(config, home))
        print(_line(nights[-1]), flush=True)
    champions = [champion for night in nights if (champion := night["steps"]["gate"]["champion"])]
    measured = [found for night in nights if (found := night["steps"]["measure"]["exploitability"])]
    if not champions or not measured:
        return report_target(f"{config.stem}: no champion with an exploiter", "one", False)
    first, last = (found["exploiters"][0] for found in (measured[0], measured[-1]))
    stays = report_target(
        f"{config.stem}, score of the champion's exploiter: {_score(first)} at first, {_score(last)} at last",
        "not risen",
        last["low"] <= first["high"],
    )
    if (known := MEASUREMENTS.get(config.stem)) is not None:
        print(f"exact exploitability: {_exact(config.stem, home, known.exploitability)}", flush=True)
    return _is_stronger(config.stem, home, champions[-1], champions[0]) and stays


def run_night(config: Path, home: Path) -> dict[str, Any]:
    """Run `league nightly --train`. Raises CalledProcessError if it reports a fault."""
    command = [sys.executable, "-c", "from cli.main import run; run()", "nightly", str(config), "--train", "--json"]
    environment = os.environ | {"LEAGUE_HOME": str(home)}
    document = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True).stdout
    night: dict[str, Any] = json.loads(document)["nights"][0]
    return night


def _line(night: dict[str, Any]) -> str:
    gate, found = night["steps"]["gate"], night["steps"]["measure"]["exploitability"]
    before = gate["champion_before"]
    change = "unchanged" if gate["champion"] == before else f"before: {before or 'none'}"
    exploited = "no exploiter" if found is None else f"its exploiter scores {_score(found['exploiters'][0])}"
    trained = len(night["steps"]["train"]["versions"])
    return (
        f"{night['league']}, night {night['night']}: {trained} versions, champion {gate['champion']} ({change});"
        f" {exploited}"
    )


def _score(found: dict[str, Any]) -> str:
    return f"{found['score']:.3f} [{found['low']:.3f}, {found['high']:.3f}]"


def _exact(league: str, home: Path, exploitability: Callable[[Any], float]) -> str:
    """The exact exploitability of all candidates for promotion, in order."""
    with closing(Registry.open(Storage.at(home))) as registry:
        policies = {version.number: load(version.ref, registry=registry) for version in eligible(registry, league)}
        return ", ".join(f"@{number} {exploitability(policy):.3f}" for number, policy in policies.items())


def _is_stronger(league: str, home: Path, last: str, first: str) -> bool:
    """Play the last champion against the first, without recording the matches."""
    if last == first:
        return report_target(f"{league}: {first} is still the champion", f"{SCORE:.0%} against the first", False)
    with closing(Registry.open(Storage.at(home))) as registry:
        row = registry.leagues.get(league)
        schedule = round_robin(row.config, row.interface, [last, first], BLOCKS)
        matches = MatchWorker(row.config, registry).play(schedule, range(schedule.length))
        score, low, high = score_interval([match.score(0) for match in matches])
    return report_target(
        f"{league}: {last} scores {score:.1%} [{low:.1%}, {high:.1%}] against {first}", f"{SCORE:.0%}", score >= SCORE
    )


if __name__ == "__main__":
    sys.exit(main())
