"""Base of all sections of a configuration."""

from collections.abc import Iterable, Mapping
from typing import Annotated, Any

from pydantic import AfterValidator, ValidationError, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError

from league.errors import did_you_mean
from league.frozen import FrozenModel
from league.refs import of_league, parse_ref

JSON = dict[str, Any]


class Part(FrozenModel, allow_inf_nan=False):
    """Base of what users write. It rejects non-finite numbers too, and says which keys there are."""

    @model_validator(mode="before")
    @classmethod
    def _has_known_keys(cls, value: Any) -> Any:
        if not isinstance(value, Mapping) or cls.model_config["extra"] != "forbid":
            return value
        names = sorted(field.alias or name for name, field in cls.model_fields.items())
        faults, choices = [], f", expected one of {', '.join(names)}"
        for key in (str(key) for key in value if key not in names):
            if not (hint := did_you_mean(key, names)):
                hint, choices = choices, ""
            fault = PydanticCustomError("unknown_key", "unknown key{hint}", {"hint": hint})
            faults.append(InitErrorDetails(type=fault, loc=(key,), input=None))
        if faults:
            raise ValidationError.from_exception_data(cls.__name__, faults)
        return value

    def refuse(self, settings: Iterable[str], problem: str) -> None:
        """Raise ValueError for the first of some settings that is not its default. problem: with {} for its name."""
        for name in settings:
            if getattr(self, name) != type(self).model_fields[name].get_default():
                raise ValueError(problem.format(name))


def _check_contestant(ref: str) -> str:
    parse_ref(of_league(ref, "league"))
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
