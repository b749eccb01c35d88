"""Base of all sections of a configuration."""

from typing import Any

from pydantic import BaseModel, ConfigDict

JSON = dict[str, Any]


class Part(BaseModel):
    """Base of configuration models: frozen, rejects unknown keys and non-finite numbers."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
