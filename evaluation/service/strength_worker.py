"""Plays the matches that measure the strength of versions and of a sweep's trials, in a process of low priority.

    python -m evaluation.service.strength_worker

A request is `{"league": "connect_four", "version": 7, "games": 200}`, and its response has the `rows`; or
`{"league": "connect_four", "files": "/tmp/trial", "opponents": ["connect_four@5"], "games": 200}`, and its response has
the `scores`; see `league.subprocesses.answer_requests`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import closing
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

from evaluation.matches.worker import MatchWorker
from evaluation.service.strength import measure_export, measure_strength
from evaluation.statistics.blas import single_threaded_blas
from league.errors import LeagueError, one_line
from league.registry.registry import Registry
from league.settings import Storage
from league.subprocesses import answer_requests, lower_priority


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
