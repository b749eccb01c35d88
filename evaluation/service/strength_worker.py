"""Strength during training: a version that a run has published plays the champion and an anchor, a trial of a sweep the
champion and all anchors, in a process of low priority.

    python -m evaluation.service.strength_worker

A request is `{"league": "connect_four", "version": 7, "games": 200}`, and its response has the `rows`; or
`{"league": "connect_four", "files": "/tmp/trial", "opponents": ["connect_four@5"], "games": 200}`, and its response has
the `scores`; see `league.subprocesses.answer_requests`.

The scores show the progress of a run and compare trials. They are no evidence: all versions play the same games, which
are not in the ledger and count neither in ratings nor in verdicts. A version plays them again in the same way, because
the schedule and its seed are fixed.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import asdict
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

from evaluation.matches.seating import Roster
from evaluation.matches.tournament import chunks_of
from evaluation.matches.worker import MatchWorker, num_envs
from evaluation.schedules.builders import strength_test
from evaluation.statistics.blas import single_threaded_blas
from evaluation.statistics.payoff import score_interval
from league.errors import LeagueError, one_line
from league.policies.loading import strength_opponents
from league.policies.onnx import OnnxPolicy
from league.registry.registry import Registry
from league.registry.storage.manifest import MANIFEST, Manifest
from league.registry.storage.rows import StrengthRow, VersionRow
from league.registry.training.strength import StrengthScore
from league.results.records import GAMES_PER_BLOCK, Match
from league.settings import Storage
from league.subprocesses import answer_requests, lower_priority

MOST_SECONDS = 60.0
"""CPU time of the matches against one opponent. Later matches are not played, so that a slow environment does not keep
a run from ending."""


def opponents_of(registry: Registry, version: VersionRow) -> list[str]:
    """Return the fixed references of a version's opponents: the champion, if there is one, and the first anchor.

    An exploiter plays the version that it was trained against.
    """
    if version.exploits is not None:
        return [version.exploits]
    config = registry.leagues.get(version.league).config
    return strength_opponents(config, registry, version=version.ref, most_anchors=1)


def measure_strength(registry: Registry, worker: MatchWorker, number: int, games: int) -> list[StrengthRow]:
    """Play the matches of a version in this process.

    Args:
        registry: Registry of the league.
        worker: Plays matches of the league.
        number: Number of the version.
        games: Games per opponent, at least 2.

    Returns:
        One row per opponent.

    Raises:
        LeagueError: An unknown or retired version, and the errors of `MatchWorker.play`.
    """
    version = registry.versions.get(worker.config.league, number)
    origin: dict[str, Any] = {"league": version.league, "version": number, "run": version.run, "steps": version.steps}
    scores = (score_against(worker, version.ref, opponent, games) for opponent in opponents_of(registry, version))
    return [StrengthRow(**asdict(score), **origin, at=datetime.now(UTC)) for score in scores]


def measure_export(worker: MatchWorker, directory: Path, opponents: Sequence[str], games: int) -> list[StrengthScore]:
    """Play the matches of a policy that is not published.

    Args:
        worker: Plays matches of the league.
        directory: Its graphs and its manifest.
        opponents: Fixed references.
        games: Games per opponent, at least 2.

    Returns:
        One score per opponent.

    Raises:
        LeagueError: A corrupt file, and the errors of `MatchWorker.play`.
    """
    file = directory / MANIFEST
    manifest = Manifest.from_json(file.read_bytes(), str(file))
    policies = {
        policy: OnnxPolicy(directory / part.file, part, manifest.has_distribution)
        for policy, part in manifest.policies.items()
    }
    ref = f"{manifest.league}@{manifest.version}"
    guests = {ref: {agent: (policy, policies[policy]) for agent, policy in worker.interface.policies.items()}}
    return [score_against(worker, ref, opponent, games, guests) for opponent in opponents]


def score_against(
    worker: MatchWorker, ref: str, opponent: str, games: int, guests: Roster = MappingProxyType({})
) -> StrengthScore:
    """Play a contestant's matches against an opponent. guests: see `MatchWorker.play`."""
    schedule = strength_test(worker.config, worker.interface, ref, opponent, games // GAMES_PER_BLOCK)
    matches, end = list[Match](), time.process_time() + MOST_SECONDS
    for chunk in chunks_of(schedule.length, 0, num_envs(worker.config)):
        matches += worker.play(schedule, chunk, expendable=True, guests=guests)
        if time.process_time() > end:
            break
    if not matches:
        raise LeagueError(f"schedule {schedule.id} has no matches")
    mean, low, high = score_interval([match.score(match.contestants.index(ref)) for match in matches])
    return StrengthScore(opponent, GAMES_PER_BLOCK * len(matches), mean, low, high)


def measured(registry: Registry, worker: MatchWorker, request: Mapping[str, Any]) -> dict[str, Any]:
    """Measure the strength of a version, or of files. Returns the scores. Raises LeagueError, also for other
    exceptions."""
    games = request["games"]
    try:
        if "files" in request:
            scores = measure_export(worker, Path(request["files"]), request["opponents"], games)
            return {"scores": [asdict(score) for score in scores]}
        rows = measure_strength(registry, worker, request["version"], games)
    except LeagueError:
        raise
    except Exception as error:  # of an environment or a bot: training goes on
        raise LeagueError(one_line(error, with_type=True)) from error
    finally:
        worker.close_environment()  # the next measurement may be hours away
    return {"rows": [asdict(row) | {"at": row.at.isoformat()} for row in rows]}


def main() -> None:
    """Respond to the requests of the process that trains."""
    lower_priority()
    with closing(Registry.open(Storage.from_environment(), create=False)) as registry, single_threaded_blas():

        @cache
        def worker(league: str) -> MatchWorker:
            return MatchWorker(registry.leagues.get(league).config, registry)

        def respond(line: bytes) -> tuple[dict[str, Any], bytes]:
            request = json.loads(line)
            return measured(registry, worker(request["league"]), request), b""

        answer_requests(respond)


if __name__ == "__main__":
    main()
