"""What is asked for: `connect_four`, `connect_four@3`, `duo.left@champion`."""

from dataclasses import dataclass
from functools import lru_cache

from league.refs import PolicyRef, parse_version


@dataclass(frozen=True, slots=True)
class Model:
    """A policy of a league, at a version: a number, an alias, or None for the champion of each moment."""

    policy: PolicyRef
    version: int | str | None = None

    @property
    def path(self) -> str:
        """Of its routes."""
        return f"/v1/policies/{self.policy}"

    @property
    def query(self) -> str:
        """That names the version."""
        return "" if self.version is None else f"?version={self.version}"

    def at(self, version: int) -> "Model":
        """The same policy, pinned."""
        return Model(self.policy, version)

    def __str__(self) -> str:
        return str(self.policy) if self.version is None else f"{self.policy}@{self.version}"


@lru_cache(maxsize=1024)  # the same few come with every call
def parse_model(text: str) -> Model:
    """Read `LEAGUE[.POLICY][@VERSION]`. Raises InvalidReference."""
    policy, at, version = text.partition("@")
    return Model(PolicyRef.parse(policy), parse_version(version) if at else None)
