"""Base of all sections of a configuration."""

from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict

from league.errors import InvalidReference
from league.refs import of_league, parse_ref

JSON = dict[str, Any]


class Part(BaseModel):
    """Base of configuration models: frozen, rejects unknown keys and non-finite numbers."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def _check_contestant(ref: str) -> str:
    try:
        parse_ref(of_league(ref, "league"))
    except InvalidReference as error:
        raise ValueError(str(error)) from error
    return ref


ContestantRef = Annotated[str, AfterValidator(_check_contestant)]
"""A reference of a version, script or bot, in which `@3` is short for a version of the league."""
