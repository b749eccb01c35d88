"""The manifest of a version: `manifest.json`, the last file written and the root of all digests.

The manifest of a mixture names versions of the league with probabilities, one of which plays each episode. Who plays an
episode is a function of the episode's name, so that every replica, a replay and a local program agree.
"""

import hashlib
import math
from bisect import bisect_right
from collections.abc import Mapping
from functools import cached_property
from itertools import accumulate
from typing import Any, Literal, Self

from pydantic import AwareDatetime, Field, ValidationError, model_validator

from league.conditions import VALUE_BASED
from league.config.environment import EnvironmentConfig
from league.config.validation_errors import describe_validation_error
from league.errors import ArtifactCorrupt, InvalidInput
from league.frozen import FrozenModel
from league.interface import Interface
from league.spaces import Space

MOST_SIMULATIONS = 10_000
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


SearchRule = Literal["puct", "gumbel"]


class SearchSettings(FrozenModel):
    """The version that a search version plays with, and its search."""

    version: int = Field(ge=1)
    sha256: str
    """Digest of the version's manifest.json."""
    rule: SearchRule
    simulations: int = Field(ge=1, le=MOST_SIMULATIONS)
    ms: float = Field(gt=0)
    """Milliseconds of a search from the initial position, on the machine that published the version."""

    @property
    def versions(self) -> tuple[int, ...]:
        """The number of the version, as in a mixture."""
        return (self.version,)

    def __str__(self) -> str:
        return f"@{self.version}, {self.simulations} simulations, {self.rule}, {self.ms:.3g} ms"


def episode_position(league: str, episode: bytes, purpose: bytes = b"mixture") -> float:
    """Return the position of an episode among all episodes of a league, in [0, 1), uniformly distributed.

    It depends on the arguments only. Positions for different purposes are independent.
    """
    digest = hashlib.blake2b(league.encode() + b"\0" + episode, digest_size=8, person=purpose).digest()
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


MANIFEST = "manifest.json"
TRAINING = "training"
"""Directory of RLlib's state, which only training reads."""
PROBES, VALUE = ".probes.npz", ".value.onnx"
"""Suffixes of a policy's files of probes and of its value."""

Role = Literal["main", "exploiter", "mixture", "search"]
MAIN: Role = "main"
EXPLOITER: Role = "exploiter"
"""The role of a version that was trained against one version only. It cannot become champion."""
MIXTURE: Role = "mixture"
"""The role of a version that consists of other versions with probabilities. It has no policies of its own."""
SEARCH: Role = "search"
"""The role of a version that plays another version with a search. It has no policies of its own."""


def trained_role(exploits: str | None) -> Role:
    """Return the role of a trained version. exploits: the version that an exploiter was trained against."""
    return MAIN if exploits is None else EXPLOITER


class Tensor(FrozenModel):
    """An input or output of a graph. The batch dimension is None."""

    name: str
    dtype: str
    shape: tuple[int | None, ...]


class Parity(FrozenModel):
    """Result of comparing a graph with the trained module."""

    observations: int
    """Number of compared observations, sampled from the environment."""
    mismatches: int
    """Greedy actions that differ, without near ties."""
    near_ties: int
    """Greedy actions that differ while the two best logits are closer than 1e-5."""
    max_difference: float
    """Maximum absolute difference of the distribution inputs."""


class PolicyManifest(FrozenModel):
    """A policy: an ONNX graph that contains its weights."""

    file: str
    observation: Space
    action: Space
    inputs: tuple[Tensor, ...]
    outputs: tuple[Tensor, ...]
    state: tuple[Tensor, ...] = ()
    """The recurrent inputs `state_in_<i>`, zero at the start of an episode; `<i>` is a number or `action`."""
    parity: Parity
    probes: str | None = None
    """File of the probes (policies/probes.py) that are checked before serving; None if there are none."""
    value: str | None = None
    """File of a second graph, which servers do not load: the same observations to `action_dist_inputs` and `value`, the
    discounted return that is expected. None for value functions that do not depend on one observation alone."""

    @property
    def files(self) -> tuple[str, ...]:
        """The graphs and the probes."""
        return tuple(file for file in (self.file, self.probes, self.value) if file is not None)


class Manifest(FrozenModel):
    """The description of a version: environment, policies, origin and the digest of each file."""

    league: str
    version: int
    created_at: AwareDatetime
    interface: Interface
    policies: dict[str, PolicyManifest]
    environment: EnvironmentConfig
    environment_digest: str
    algorithm: str
    settings: dict[str, Any]
    seed: int
    steps: int
    """Actions of all agents during training, including its ancestors."""
    parent: int | None = None
    role: Role = MAIN
    exploits: str | None = None
    """The version that an exploiter was trained against: `connect_four@3`."""
    mixture: Mixture | None = None
    """The versions of a mixture."""
    search: SearchSettings | None = None
    """The search of a search version."""
    git_commit: str | None = None
    stack: dict[str, str]
    """package → version"""
    files: dict[str, str] = Field(default={})
    """relative path → SHA-256 of every other file; filled in when the version is published"""

    @property
    def agents(self) -> dict[str, str]:
        """agent → policy id"""
        return self.interface.policies

    @property
    def has_distribution(self) -> bool:
        """Whether actions can be sampled. Graphs of value-based algorithms have action values in place of logits, and
        imported models may output finished actions."""
        return self.algorithm not in VALUE_BASED and not self.settings.get("greedy", False)

    @model_validator(mode="after")
    def _agrees_with_itself(self) -> Self:
        if (self.role == MIXTURE) != (self.mixture is not None):
            raise ValueError(f"role {self.role} does not fit the members: exactly mixtures have some")
        if (self.role == SEARCH) != (self.search is not None):
            raise ValueError(f"role {self.role} does not fit search: exactly search versions have one")
        is_trained = self.mixture is None and self.search is None
        if is_trained and set(self.policies) != set(self.interface.policy_ids):
            raise ValueError(f"policies must be {', '.join(self.interface.policy_ids)}, as the interface says")
        for name, policy in self.policies.items():
            spaces = self.interface.of_policy(name)
            if (policy.observation, policy.action) != (spaces.observation, spaces.action):
                raise ValueError(f"policy {name} has other spaces than its agents")
        if self.environment_digest != self.environment.digest():
            raise ValueError("environment_digest is not that of the environment")
        if self.policies and not is_trained:
            raise ValueError(f"a version with the role {self.role} has no policies of its own")
        if (self.role == EXPLOITER) != (self.exploits is not None):
            raise ValueError(f"role {self.role} does not fit exploits {self.exploits}: exploiters name one version")
        return self

    def to_json(self) -> str:
        """Return the text of `manifest.json`."""
        return self.model_dump_json(indent=2, by_alias=True) + "\n"

    @classmethod
    def from_json(cls, text: str | bytes, source: str) -> Self:
        """Parse `manifest.json`. Raises ArtifactCorrupt, which names `source`."""
        try:
            return cls.model_validate_json(text)
        except ValidationError as error:
            raise ArtifactCorrupt(f"{source}: {describe_validation_error(error, text)}") from error
