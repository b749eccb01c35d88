"""Base of the documents that are read from files and requests."""

from pydantic import BaseModel, ConfigDict


class FrozenModel(BaseModel):
    """A document that cannot be changed, and has no unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid")
