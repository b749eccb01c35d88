"""The process that measures the strength of versions and trials, as seen from the process that trains them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from league.registry.storage.rows import StrengthRow, VersionRow
from league.registry.training.strength import StrengthScore
from league.settings import Storage
from league.subprocesses import RequestProcess


class StrengthProcess:
    """Starts with the first measurement, and again after it has died. One call at a time."""

    def __init__(self, storage: Storage) -> None:
        module = "evaluation.service.strength_worker"
        self._process = RequestProcess(module, environment=storage.environment, work="plays the matches")

    def __call__(self, version: VersionRow, games: int) -> list[StrengthRow]:
        """Play the matches of a version, `games` games per opponent, and return one row per opponent.

        Raises WorkerLost if the process died, and the LeagueError that it reports.
        """
        request = {"league": version.league, "version": version.number, "games": games}
        response, _ = self._process.request(json.dumps(request))
        return [StrengthRow(**row | {"at": datetime.fromisoformat(row["at"])}) for row in response["rows"]]

    def of_files(self, league: str, files: Path, opponents: Sequence[str], games: int) -> list[StrengthScore]:
        """Play the matches of a policy that is not published, whose graphs and manifest are in the directory `files`.

        Returns one score per opponent, after at most `games` games. Raises as a call does.
        """
        request = {"league": league, "files": str(files), "opponents": list(opponents), "games": games}
        response, _ = self._process.request(json.dumps(request))
        return [StrengthScore(**score) for score in response["scores"]]

    def close(self) -> None:
        """End the process, also during a measurement."""
        self._process.close()
