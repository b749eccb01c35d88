"""What every part of a configuration keeps to."""

from pydantic import BaseModel, ConfigDict


class Part(BaseModel):
    """Frozen; refuses unknown keys and numbers that are not finite."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
