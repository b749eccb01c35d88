"""Plays the matches that measure the strength of a run's versions, in a process of low priority.

    python -m evaluation.service.strength_worker connect_four

Each line of standard input is a request, `{"version": 7, "games": 200}`; each line of standard output is its response:
a list of rows, or an error. The process ends when its input does, also during a match.
"""

from __future__ import annotations

import json
import os
import queue
import sys
import threading
from contextlib import closing
from dataclasses import asdict
from typing import Any

from evaluation.matches.worker import MatchWorker
from evaluation.service.strength import measure_strength
from evaluation.statistics.blas import single_threaded_blas
from league.errors import LeagueError, one_line, to_document
from league.registry.registry import Registry
from league.settings import Storage
from league.subprocesses import lower_priority


def respond(registry: Registry, worker: MatchWorker, request: dict[str, Any]) -> list[dict[str, Any]] | dict[str, str]:
    """Measure the strength of a version. Returns its rows, or the error that ended the matches."""
    try:
        rows = measure_strength(registry, worker, request["version"], request["games"])
    except LeagueError as error:
        return to_document(error)
    except Exception as error:  # of an environment or a bot: training goes on
        return to_document(LeagueError(one_line(error, with_type=True)))
    return [asdict(row) | {"at": row.at.isoformat()} for row in rows]


def _read(requests: queue.SimpleQueue[bytes]) -> None:
    for line in sys.stdin.buffer:
        requests.put(line)
    os._exit(0)


def main() -> None:
    """Respond to requests about the league given on the command line."""
    lower_priority()
    responses = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # output of environments must not mix with responses
    requests: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(requests,), name="requests", daemon=True).start()
    with closing(Registry.open(Storage.from_environment(), create=False)) as registry, single_threaded_blas():
        worker = MatchWorker(registry.leagues.get(sys.argv[1]).config, registry)
        while True:
            print(json.dumps(respond(registry, worker, json.loads(requests.get()))), file=responses, flush=True)


if __name__ == "__main__":
    main()
