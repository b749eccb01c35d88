"""What a version says of itself: `manifest.json`, the last file written and the root of all digests."""

from typing import Any, Self

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, ValidationError, model_validator

from league.config import EnvironmentConfig
from league.errors import ArtifactCorrupt
from league.interface import Interface
from league.spaces import Space

MANIFEST = "manifest.json"
TRAINING = "training"
"""The directory of RLlib's state, which only training reads."""
PROBES = ".probes.npz"
"""Behind a policy's name: the file of its probes."""


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Tensor(_Record):
    """One input or output of a graph. A dimension of the batch is None."""

    name: str
    dtype: str
    shape: tuple[int | None, ...]


class Parity(_Record):
    """The proof that a graph acts as the trained module does."""

    observations: int
    """How many observations, gathered from the environment, were compared."""
    mismatches: int
    """Greedy actions that differ, near ties apart."""
    near_ties: int
    """Greedy actions that differ where the two best logits are closer than 1e-5."""
    max_difference: float
    """Largest absolute difference of any distribution input."""


class PolicyManifest(_Record):
    """One ONNX graph, which holds its weights itself."""

    file: str
    observation: Space
    action: Space
    inputs: tuple[Tensor, ...]
    outputs: tuple[Tensor, ...]
    state: tuple[Tensor, ...] = ()
    """The recurrent inputs `state_in_<i>`, zeros at the start of an episode; `<i>` is a number, or `action`."""
    parity: Parity
    probes: str | None = None
    """The file of its probes (policies/probes.py), which it answers before it serves; None in versions without."""


class Manifest(_Record):
    """A version, whole: what it plays, with what, where it came from, and the digest of each file."""

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
    """Actions of all agents that training took, those of its parents included."""
    parent: int | None = None
    git_commit: str | None = None
    stack: dict[str, str]
    """package → version"""
    files: dict[str, str] = Field(default={})
    """relative path → SHA-256, of every file but this one; filled in when the version is published"""

    @property
    def agents(self) -> dict[str, str]:
        """agent → policy id"""
        return self.interface.policies

    @model_validator(mode="after")
    def _agrees_with_itself(self) -> Self:
        if set(self.policies) != set(self.interface.policy_ids):
            raise ValueError(f"policies must be {', '.join(self.interface.policy_ids)}, as the interface says")
        for name, policy in self.policies.items():
            spaces = self.interface.of_policy(name)
            if (policy.observation, policy.action) != (spaces.observation, spaces.action):
                raise ValueError(f"policy {name} has other spaces than its agents")
        if self.environment_digest != self.environment.digest():
            raise ValueError("environment_digest is not that of the environment")
        return self

    def to_json(self) -> str:
        """The text of `manifest.json`."""
        return self.model_dump_json(indent=2, by_alias=True) + "\n"

    @classmethod
    def from_json(cls, text: str | bytes, source: str) -> Self:
        """Read `manifest.json`. `source` names it in the ArtifactCorrupt that a wrong one raises."""
        try:
            return cls.model_validate_json(text)
        except ValidationError as error:
            first = error.errors()[0]
            key = ".".join(str(part) for part in first["loc"])
            raise ArtifactCorrupt(f"{source}: {key or 'manifest'}: {first['msg']}") from error
