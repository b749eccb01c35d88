"""Base of the documents that are read from files and requests."""

from pydantic import BaseModel, ConfigDict


class FrozenModel(BaseModel):
    """A document that cannot be changed, and has no unknown keys."""

    # Most commands use few of the models: their validators are built at the first use.
    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)
