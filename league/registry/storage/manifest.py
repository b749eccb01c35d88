"""The manifest of a version: `manifest.json`, the last file written and the root of all digests."""

from typing import Any, Literal, Self

from pydantic import AwareDatetime, Field, ValidationError, model_validator

from league.conditions import VALUE_BASED
from league.config.environment import EnvironmentConfig
from league.config.validation_errors import describe_validation_error
from league.errors import ArtifactCorrupt
from league.frozen import FrozenModel
from league.interface import Interface
from league.registry.storage.mixture import Mixture
from league.spaces import Space

MANIFEST = "manifest.json"
TRAINING = "training"
"""Directory of RLlib's state, which only training reads."""
PROBES = ".probes.npz"
"""Suffix of a policy's file of probes."""

Role = Literal["main", "exploiter", "mixture"]
MAIN: Role = "main"
EXPLOITER: Role = "exploiter"
"""The role of a version that was trained against one version only. It cannot become champion."""
MIXTURE: Role = "mixture"
"""The role of a version that consists of other versions with probabilities. It has no policies of its own."""


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
        if self.mixture is None and set(self.policies) != set(self.interface.policy_ids):
            raise ValueError(f"policies must be {', '.join(self.interface.policy_ids)}, as the interface says")
        for name, policy in self.policies.items():
            spaces = self.interface.of_policy(name)
            if (policy.observation, policy.action) != (spaces.observation, spaces.action):
                raise ValueError(f"policy {name} has other spaces than its agents")
        if self.environment_digest != self.environment.digest():
            raise ValueError("environment_digest is not that of the environment")
        if self.mixture is not None and self.policies:
            raise ValueError("a mixture has no policies of its own")
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
            raise ArtifactCorrupt(f"{source}: {describe_validation_error(cls, error)}") from error
