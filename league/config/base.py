"""Base of all sections of a configuration."""

from typing import Annotated, Any

import yaml
from pydantic import AfterValidator

from league.errors import InvalidReference
from league.frozen import FrozenModel
from league.refs import of_league, parse_ref

JSON = dict[str, Any]


class Part(FrozenModel, allow_inf_nan=False):
    """Base of configuration models, which rejects non-finite numbers too."""


class UniqueKeyLoader(yaml.SafeLoader):
    """Loads YAML without a key that occurs twice in a mapping, of which PyYAML would keep the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Return the mapping. Raises ConstructorError for a repeated key."""
        earlier_keys = set[tuple[str, str]]()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and (key.tag, key.value) in earlier_keys:
                raise yaml.constructor.ConstructorError(
                    problem=f"the key {key.value!r} occurs twice", problem_mark=key.start_mark
                )
            earlier_keys.add((key.tag, str(key.value)))
        return super().construct_mapping(node, deep)


def _check_contestant(ref: str) -> str:
    try:
        parse_ref(of_league(ref, "league"))
    except InvalidReference as error:
        raise ValueError(str(error)) from error
    return ref


ContestantRef = Annotated[str, AfterValidator(_check_contestant)]
"""A reference of a version, script or bot, in which `@3` is short for a version of the league."""
