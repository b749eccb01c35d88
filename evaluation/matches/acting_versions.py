"""Draws the member of a mixture that plays each game, from the seed of the game."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evaluation.schedules.builders import GamePlans
from league.registry.storage.mixture import Mixture
from league.results.records import Members, Schedule

NO_MIXTURES: Mapping[str, Mixture] = {}


@dataclass(frozen=True, slots=True)
class ActingVersions:
    """Who plays the games of some plans in place of mixtures.

    Attributes:
        refs: The contestants of the schedule, followed by the members of mixtures that were drawn.
        indices: Who acts for each contestant of the match, as an index into `refs`, (g, 2).
        members: Of each game, see `Game.members`, (g,).
    """

    refs: tuple[str, ...]
    indices: NDArray[np.int64]
    members: tuple[Members, ...]


def acting_versions(schedule: Schedule, plans: GamePlans, mixtures: Mapping[str, Mixture]) -> ActingVersions:
    """Draw who plays the games of `plans`.

    mixtures: contestant → its members. A draw depends on the seed of the game, its number in the block and the mixture
    only: two contestants that play against one mixture from common seeds meet the same members.
    """
    refs, games = schedule.contestants, range(len(plans))
    if not mixtures.keys() & set(refs):
        return ActingVersions(refs, plans.contestants, ((),) * len(games))
    number = {ref: index for index, ref in enumerate(refs)}
    indices, members = plans.contestants.copy(), list[Members]()
    for game in games:
        drawn: list[int | None] = []
        for place, contestant in enumerate(plans.contestants[game].tolist()):
            ref = refs[contestant]
            version = None
            if ref in mixtures:
                episode = f"{plans.seeds[game]}/{plans.indices[game]}/{ref}"
                version = mixtures[ref].version_of(schedule.league, episode.encode())
                acting = f"{schedule.league}@{version}"
                indices[game, place] = number.setdefault(acting, len(number))
            drawn.append(version)
        members.append(() if drawn == [None] * len(drawn) else tuple(drawn))
    return ActingVersions(tuple(number), indices, tuple(members))
