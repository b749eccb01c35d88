"""The strength of a trial: the policies of its checkpoints play the champion and the anchors.

The opponents are fixed when the sweep begins, and all trials play the same games against them, so that scores of trials
differ less by chance. The games are played in another process of low priority, beside the trial, which waits for them.
They are not recorded.
"""

import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import torch

from league.config.league import LeagueConfig
from league.interface import Interface
from league.registry.storage.manifest import MANIFEST
from league.registry.training.strength import StrengthScore
from league.settings import Storage
from training.export.publish import Checkpoint, export

STRENGTH = "strength"
LOW, HIGH = f"{STRENGTH}/low", f"{STRENGTH}/high"
"""Metrics: the bounds of the 95 % interval."""


class StrengthGames(Protocol):
    """Plays policies that are not published against contestants of the league."""

    def of_files(self, league: str, files: Path, opponents: Sequence[str], games: int) -> list[StrengthScore]:
        """Return one score per opponent, after at most `games` games against it. Raises LeagueError.

        files: directory with the graphs and the manifest of the policies.
        """

    def close(self) -> None:
        """End, also during games."""


@dataclass(frozen=True, slots=True)
class StrengthTest:
    """How a trial measures its strength. opponents: fixed references. open_games: called in the trial's process."""

    opponents: tuple[str, ...]
    open_games: Callable[[Storage], StrengthGames]


def trial_strength(
    checkpoint: Path, config: LeagueConfig, interface: Interface, opponents: Sequence[str], games: StrengthGames
) -> dict[str, float]:
    """Export the policies of `checkpoint`, let them play, and return the metrics: strength, its bounds, all scores.

    Raises LeagueError if they cannot be exported, or if a game fails.
    """
    assert config.training.strength is not None, "checked before the sweep begins"
    # Modules are initialised when they are loaded. The trial must continue as it does after an interruption.
    with torch.random.fork_rng(devices=[]), tempfile.TemporaryDirectory(prefix="league-trial-") as directory:
        files = Path(directory)
        manifest = export(Checkpoint(checkpoint, "", 0), files, 0, config=config, interface=interface)
        (files / MANIFEST).write_text(manifest.to_json())
        scores = games.of_files(config.league, files, opponents, config.training.strength.games)
    mean, low, high = mean_strength(scores)
    return {STRENGTH: mean, LOW: low, HIGH: high} | {f"{STRENGTH}/{score.opponent}": score.score for score in scores}


def mean_strength(scores: Sequence[StrengthScore]) -> tuple[float, float, float]:
    """Return the mean of independent scores with its interval, from their intervals.

    The bounds are at the distances √Σ(sᵢ − lᵢ)² / n and √Σ(uᵢ − sᵢ)² / n from the mean of the scores sᵢ with the
    intervals [lᵢ, uᵢ]: G. Y. Zou, A. Donner, "Construction of confidence limits about effect measures: a general
    approach" (2008).

    Args:
        scores: At least one score, of different opponents.

    Returns:
        Mean, lower and upper bound.
    """
    number = len(scores)
    mean = sum(score.score for score in scores) / number
    below = math.hypot(*(score.score - score.low for score in scores)) / number
    above = math.hypot(*(score.high - score.score for score in scores)) / number
    return mean, mean - below, mean + above
