"""Do ten nights of `league nightly --train` make a league stronger, and not easier to exploit?

Each night is one call of the command in a league of its own; a night trains for three minutes, and its exploiter for
the configured share of that, by default 15 %. In the end, the last champion plays the first one. Exploitability has
risen if the interval of the last champion's exploiter is above that of the first champion's: of its score, or of its
gain in returns if the gate tests returns. If `benchmarks.exploitability` knows the game, the exact exploitability of
all candidates is printed as well.

    python -m benchmarks training_nights leduc_holdem --steps 6_000_000
    python -m benchmarks training_nights leduc_holdem --nights 3 --league-share 0.5

`--steps` limits nights by actions instead of time. On a machine with other work, exploiters get equal training then.
`--league-share` sets how much of a night is played against versions of the league.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Annotated, Any

import typer
import yaml

from benchmarks.exploitability import MEASUREMENTS
from benchmarks.harness import Quick, Target
from evaluation.matches.worker import MatchWorker
from evaluation.schedules.builders import round_robin
from evaluation.statistics.payoff import paired_difference, score_interval
from league.config.league import LeagueConfig
from league.policies.loading import eligible, load
from league.registry.registry import Registry
from league.settings import Storage
from policy_league.configs.bundled import find

NIGHTS, MINUTES = 10, 3.0
SCORE = 75.0
"""Percent that the last champion must score against the first."""
BLOCKS = {"score": 200, "gain": 10_000}
"""Matches of the last champion against the first, by what is compared."""


def main(
    configs: Annotated[list[str] | None, typer.Argument(help="default: connect_four")] = None,
    quick: Quick = False,
    nights: int = NIGHTS,
    minutes: Annotated[float, typer.Option(help="training time of a night")] = MINUTES,
    steps: Annotated[int | None, typer.Option(help="actions of a night, instead of --minutes")] = None,
    league_share: Annotated[
        float | None,
        typer.Option(help="episodes against opponents from the league, 0 for none; default: the configuration's"),
    ] = None,
) -> Iterator[Target]:
    """Run the nights of each league."""
    nights, minutes = (2, 0.2) if quick else (nights, minutes)
    settings: dict[str, Any] = {"minutes": minutes} if steps is None else {"steps": steps}
    if league_share is not None:
        settings["opponents"] = {"league": {"share": league_share}} if league_share else None
    for name in configs or ["connect_four"]:
        with tempfile.TemporaryDirectory() as home:
            yield from measure(_configure(name, settings, Path(home)), Path(home), nights)


def _configure(name: str, settings: dict[str, Any], home: Path) -> Path:
    """Write a bundled configuration with these settings of a night; return its path."""
    document = yaml.safe_load(find(name).read_text())
    document["nightly"] = document.get("nightly", {}) | settings
    path = home / f"{document['league']}.yaml"
    path.write_text(yaml.safe_dump(document))
    return path


def measure(config: Path, home: Path, count: int) -> Iterator[Target]:
    """Run the nights of a league, and compare its last champion with the first."""
    league, nights, compared = config.stem, [], _compared(config)
    for _ in range(count):
        nights.append(run_night(config, home))
        print(_line(nights[-1], compared), flush=True)
    verdicts = [verdict for night in nights for verdict in night["steps"]["gate"]["verdicts"]]
    champions = [verdict["candidate"] for verdict in verdicts if verdict["outcome"] == "promote"]
    measured = [score for night in nights if (score := night["steps"]["measure"]["exploitability"])]
    yield Target(f"{league}, champions with an exploiter", min(len(champions), len(measured)), at_least=1)
    if not champions or not measured:
        return
    first, last = (_of_exploiter(score, compared) for score in (measured[0], measured[-1]))
    note = f"{last[0]:.3f}; at first {_interval(first)}"
    name = f"{league}, {compared} of the champion's exploiter, lower bound"
    yield Target(name, round(last[1], 3), at_most=round(first[2], 3), peer="the first's upper bound", note=note)
    if (measurement := MEASUREMENTS.get(league)) is not None:
        yield from _exact(league, home, measurement.exploitability, champions)
    yield from _strength(league, home, champions[-1], champions[0], compared)


def _compared(config: Path) -> str:
    """What an exploiter's success is measured by: `gain` in returns if the gate tests returns, else `score`."""
    return "gain" if LeagueConfig.load(config).gate.model == "returns" else "score"


def _of_exploiter(exploitability: dict[str, Any], compared: str) -> tuple[float, float, float]:
    """The mean score or gain of the best exploiter by its lower bound, and its interval."""
    name, results = "score", exploitability["exploiters"]
    if compared == "gain":
        name, results = "mean", [result["gain"] for result in results]
    best = max(results, key=lambda result: result["low"])
    return best[name], best["low"], best["high"]


def _interval(values: tuple[float, float, float]) -> str:
    mean, low, high = values
    return f"{mean:.3f} [{low:.3f}, {high:.3f}]"


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
    gate, score = night["steps"]["gate"], night["steps"]["measure"]["exploitability"]
    before = gate["champion_before"]
    promoted = [verdict["candidate"] for verdict in gate["verdicts"] if verdict["outcome"] == "promote"]
    change = f"before: {before or 'none'}; promoted: {', '.join(promoted)}" if promoted else "unchanged"
    trained = len(night["steps"]["train"]["versions"])
    exploited = f"{compared} of its exploiter: {_interval(_of_exploiter(score, compared))}" if score else "no exploiter"
    return (
        f"{night['league']}, night {night['night']}: {trained} versions, champion {gate['champion']} ({change});"
        f" {exploited}"
    )


def _exact(league: str, home: Path, exploitability: Callable[[Any], float], champions: list[str]) -> Iterator[Target]:
    """The exact exploitability of all candidates, and of the last champion compared with the first."""
    with closing(Registry.open(Storage.at(home))) as registry:
        refs = [contestant.ref for contestant in eligible(registry, league)]
        exact = {ref: round(exploitability(load(ref, registry=registry)), 3) for ref in refs}
    yield Target(f"{league}, exact exploitability of the candidates", tuple(exact.values()), note=", ".join(exact))
    name = f"{league}, exact exploitability of the last champion"
    yield Target(name, exact[champions[-1]], at_most=exact[champions[0]], peer="the first")


def _strength(league: str, home: Path, last: str, first: str, compared: str) -> Iterator[Target]:
    """Play the last champion against the first, without recording the matches."""
    note, score = f"{first} is still the champion", 0.5
    if last != first:
        with closing(Registry.open(Storage.at(home))) as registry:
            row = registry.leagues.get(league)
            schedule = round_robin(row.config, row.interface, [last, first], BLOCKS[compared])
            matches = MatchWorker(row.config, registry).play(schedule, range(schedule.length))
        score, low, high = score_interval([match.score(0) for match in matches])
        note = f"[{low:.1%}, {high:.1%}]"
        if compared == "gain" and (gain := paired_difference(matches, last)) is not None:
            note += f", gain {gain} per game"
    name = f"{league}, score of the last champion"
    yield Target(name, round(100 * score, 1), "%", at_least=SCORE, peer="the first", note=note)
