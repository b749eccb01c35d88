"""Base of all sections of a configuration."""

from typing import Annotated, Any

from pydantic import AfterValidator

from league.errors import InvalidReference
from league.frozen import FrozenModel
from league.refs import of_league, parse_ref

JSON = dict[str, Any]


class Part(FrozenModel, allow_inf_nan=False):
    """Base of configuration models, which rejects non-finite numbers too."""


def _check_contestant(ref: str) -> str:
    try:
        parse_ref(of_league(ref, "league"))
    except InvalidReference as error:
        raise ValueError(str(error)) from error
    return ref


def check_entry_point(name: str) -> str:
    """Return `package.module:name`. Raises ValueError for another form."""
    if not all(part.strip() for part in name.partition(":")):
        raise ValueError("expected package.module:name")
    return name


EntryPoint = Annotated[str, AfterValidator(check_entry_point)]
"""A class or function of the user's code, `package.module:name`."""
ContestantRef = Annotated[str, AfterValidator(_check_contestant)]
"""A reference of a version, script or bot, in which `@3` is short for a version of the league."""
