"""Base of all sections of a configuration."""

from typing import Any

from pydantic import BaseModel, ConfigDict

from league.errors import InvalidReference
from league.refs import of_league, parse_ref

JSON = dict[str, Any]


class Part(BaseModel):
    """Base of configuration models: frozen, rejects unknown keys and non-finite numbers."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def check_contestant(ref: str) -> str:
    """Return `ref` if it is a reference of a version, script or bot, in which `@3` is short for a league's version.

    Raises ValueError, as validators do.
    """
    try:
        parse_ref(of_league(ref, "league"))
    except InvalidReference as error:
        raise ValueError(str(error)) from error
    return ref
