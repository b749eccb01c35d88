"""Strength during training: a version that a run has published plays the champion and an anchor.

The scores show the progress of a run. They are no evidence: all versions play the same games, which are not in the
ledger and count neither in ratings nor in verdicts. A version plays them again in the same way, because the schedule
and its seed are fixed.
"""

from __future__ import annotations

import time
from datetime import UTC, datetime

from evaluation.matches.tournament import chunks_of
from evaluation.matches.worker import MatchWorker, num_envs
from evaluation.schedules.builders import ANCHOR, strength_test
from evaluation.statistics.payoff import score_interval
from league.errors import EnvironmentMismatch, LeagueError, UnknownAlias
from league.policies.loading import check_eligible, pinned
from league.refs import CHAMPION, of_league
from league.registry.registry import Registry
from league.registry.storage.rows import StrengthRow, VersionRow
from league.results.records import GAMES_PER_BLOCK, Match

MOST_SECONDS = 60.0
"""CPU time of the matches against one opponent. Later matches are not played, so that a slow environment does not keep
a run from ending."""


def strength_opponents(registry: Registry, version: VersionRow) -> list[str]:
    """Return the fixed references of a version's opponents: the champion, if there is one, and an anchor.

    The anchor is the first of `gate.anchors` that can play and is neither the version nor the champion, otherwise
    `script:random`. An exploiter plays the version that it was trained against.
    """
    if version.exploits is not None:
        return [version.exploits]
    league = registry.leagues.get(version.league)
    refs = [f"@{CHAMPION}", *(anchor.ref for anchor in league.config.gate.anchors)]
    champion, *anchors = (_opponent(registry, version, ref) for ref in refs)
    anchor = next((opponent for opponent in anchors if opponent not in (None, champion)), ANCHOR)
    return [opponent for opponent in (champion, anchor) if opponent is not None]


def _opponent(registry: Registry, version: VersionRow, ref: str) -> str | None:
    """A reference that is pinned; None if it does not exist, cannot play, or is the version itself."""
    config = registry.leagues.get(version.league).config
    try:
        opponent = pinned(of_league(ref, version.league), version.league, registry)
        check_eligible(opponent, registry, config)
    except (UnknownAlias, EnvironmentMismatch):
        return None
    return None if opponent == version.ref else opponent


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
    rows = []
    for opponent in strength_opponents(registry, version):
        matches = _play(worker, version.ref, opponent, games // GAMES_PER_BLOCK)
        scores = [match.score(match.contestants.index(version.ref)) for match in matches]
        mean, low, high = score_interval(scores)
        rows.append(
            StrengthRow(
                league=version.league,
                version=number,
                opponent=opponent,
                run=version.run,
                steps=version.steps,
                games=GAMES_PER_BLOCK * len(matches),
                score=mean,
                low=low,
                high=high,
                at=datetime.now(UTC),
            )
        )
    return rows


def _play(worker: MatchWorker, version: str, opponent: str, blocks: int) -> list[Match]:
    schedule = strength_test(worker.config, worker.interface, version, opponent, blocks)
    matches, end = list[Match](), time.process_time() + MOST_SECONDS
    for chunk in chunks_of(schedule.length, 0, num_envs(worker.config)):
        matches += worker.play(schedule, chunk, expendable=True)
        if time.process_time() > end:
            break
    if not matches:
        raise LeagueError(f"schedule {schedule.id} has no matches")
    return matches
