"""A mixture: versions of a league with probabilities, one of which plays each episode.

Who plays an episode is a function of the episode's name, so that every replica, a replay and a local program agree.
"""

import hashlib
import math
from bisect import bisect_right
from collections.abc import Mapping
from functools import cached_property
from itertools import accumulate
from typing import Self

from pydantic import Field, model_validator

from league.errors import InvalidInput
from league.frozen import FrozenModel

TOLERANCE = 1e-3
"""By which the probabilities that a user writes may differ from 1 in total: three thirds are written as 0.333."""


class Member(FrozenModel):
    """A version of a mixture."""

    version: int = Field(ge=1)
    probability: float = Field(gt=0, le=1)
    sha256: str
    """Digest of the version's manifest.json."""


class Mixture(FrozenModel, ignored_types=(cached_property,)):
    """Versions with probabilities that sum to 1, by number."""

    members: tuple[Member, ...] = Field(min_length=2)

    @model_validator(mode="after")
    def _is_a_distribution(self) -> Self:
        numbers = self.versions
        if list(numbers) != sorted(set(numbers)):
            raise ValueError("the members must be different versions in ascending order")
        if not math.isclose(sum(member.probability for member in self.members), 1, abs_tol=1e-9):
            raise ValueError("the probabilities of the members must sum to 1")
        return self

    @property
    def versions(self) -> tuple[int, ...]:
        """The numbers of the members."""
        return tuple(member.version for member in self.members)

    @property
    def likeliest(self) -> int:
        """The version with the highest probability, the newest one of several."""
        return max(self.members, key=lambda member: (member.probability, member.version)).version

    @cached_property
    def _bounds(self) -> list[float]:
        return list(accumulate(member.probability for member in self.members[:-1]))

    def index_at(self, position: float) -> int:
        """Return the index of the member at a position in [0, 1), in which each has an interval of its probability."""
        return bisect_right(self._bounds, position)

    def version_of(self, league: str, episode: bytes) -> int:
        """Return the version that plays an episode."""
        return self.members[self.index_at(episode_position(league, episode))].version

    def __str__(self) -> str:
        return ", ".join(f"@{member.version} {100 * member.probability:.1f} %" for member in self.members)


def episode_position(league: str, episode: bytes) -> float:
    """Return the position of an episode among all episodes of a league, in [0, 1), uniformly distributed.

    It depends on both names only. It is independent of the position that decides about a canary.
    """
    digest = hashlib.blake2b(league.encode() + b"\0" + episode, digest_size=8, person=b"mixture").digest()
    return int.from_bytes(digest[:6], "big") / 2**48  # exact as a double, so the result is less than 1


def normalised(shares: Mapping[int, float]) -> dict[int, float]:
    """Return version → probability with a sum of exactly 1 but for rounding, by number.

    Raises InvalidInput unless there are several versions whose probabilities are positive and sum to 1 within
    TOLERANCE.
    """
    if len(shares) < 2:
        raise InvalidInput(f"a mixture has {len(shares)} version, expected at least two")
    for number, share in shares.items():
        if not 0 < share <= 1:
            raise InvalidInput(f"version {number} has the probability {share:g}, expected more than 0 and at most 1")
    total = math.fsum(shares.values())
    if abs(total - 1) > TOLERANCE + 1e-9:
        raise InvalidInput(f"the probabilities of the mixture sum to {total:.6g}, expected 1 (±{TOLERANCE:g})")
    return {number: shares[number] / total for number in sorted(shares)}
