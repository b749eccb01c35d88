"""Errors of a configuration in one line, with the key, the expected value and similar known keys."""

import difflib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

import yaml
from pydantic import BaseModel, ValidationError

from league.config.algorithms import MODELS
from league.config.schedules import SCHEDULE_FORMS
from league.config.training import TrainingSettings
from league.errors import one_line

SHOWN = 3
"""Number of faults in a message."""
TYPES = {
    "tuple_type": "a list",
    "list_type": "a list",
    "dict_type": "a mapping",
    "model_type": "a mapping",
    "model_attributes_type": "a mapping",
    "string_type": "a string",
    "float_type": "a number",
    "float_parsing": "a number",
    "int_type": "an integer",
    "int_parsing": "an integer",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
}
"""Pydantic's type of an error → what YAML calls the expected value."""
BASIC_TYPES = ("str", "int", "float", "bool")


def describe_yaml_error(error: Exception) -> str:
    """Return why a file is not YAML, and the line. PyYAML also raises ValueError and RecursionError."""
    if isinstance(error, yaml.MarkedYAMLError) and error.problem_mark is not None and error.problem:
        return f"line {error.problem_mark.line + 1}: not valid YAML: {error.problem}"
    return f"not a YAML file: {one_line(error)}"


def describe_validation_error(model: type[BaseModel], error: ValidationError) -> str:
    """Return the first faults as a sentence that names the keys and the expected values, unknown keys first."""
    faults = [Fault.of(model, detail) for detail in error.errors()]
    # Without those of a collection with a faulty item, and keys that are missing because they are misspelt.
    paths = [fault.path for fault in faults]
    misspelt = {(*fault.path[:-1], fault.guess) for fault in faults if fault.guess is not None}
    root_faults = [
        fault
        for fault in faults
        if not (fault.kind == "missing" and fault.path in misspelt)
        and not any(len(path) > len(fault.path) and path[: len(fault.path)] == fault.path for path in paths)
    ]
    # A value that has none of several types is one fault.
    combined: dict[tuple[Any, ...], Fault] = {}
    for fault in root_faults:
        other = combined.setdefault((fault.path, fault.message), fault)
        expected = tuple(dict.fromkeys((*other.expected, *fault.expected)))
        combined[fault.path, fault.message] = replace(fault, expected=expected)
    unknown_first = sorted(combined.values(), key=lambda fault: not fault.is_unknown_key)
    first = list({str(fault): fault for fault in unknown_first}.values())[:SHOWN]
    # Several keys of one mapping have the same list.
    lists = [fault.listed for fault in first]
    return "; ".join(
        f"{fault}{'' if fault.listed in lists[:number] else fault.listed}" for number, fault in enumerate(first)
    )


@dataclass(frozen=True)
class Fault:
    """One of pydantic's errors.

    path: keys and indices, without the names of union members; guess: a similar key; listed: the list of known keys, if
    none is similar; expected: the types that the value does not have.
    """

    path: tuple[str | int, ...]
    kind: str
    message: str
    guess: str | None = None
    listed: str = ""
    expected: tuple[str, ...] = ()

    @classmethod
    def of(cls, model: type[BaseModel], detail: Any) -> "Fault":
        """Read an error of `model`."""
        path, known_by, start = list(detail["loc"]), model, 0
        if path[:1] == ["training"] and len(path) > 1 and path[1] in MODELS:
            known_by, start = MODELS[path.pop(1)], 1
        if issubclass(known_by, TrainingSettings):
            path = [part for part in path if part not in SCHEDULE_FORMS]
        kind = detail["type"]
        # Pydantic puts the member of a union that it tried into the path: `tuple[str, ...]`, or a basic type.
        path = [
            part
            for part in path
            if isinstance(part, int) or not ("[" in part or (part in BASIC_TYPES and kind.endswith("_type")))
        ]
        if kind in TYPES:
            return cls(tuple(path), kind, f"got {detail['input']!r}", expected=(TYPES[kind],))
        if kind != "extra_forbidden":
            return cls(tuple(path), kind, _message(detail))
        known_keys = _known_keys(known_by, path[start:-1])
        if guesses := difflib.get_close_matches(str(path[-1]), known_keys, n=1):
            return cls(tuple(path), "extra_forbidden", f"unknown key, did you mean {guesses[0]!r}?", guesses[0])
        listed = f", expected one of {', '.join(sorted(known_keys))}" if known_keys else ""
        return cls(tuple(path), "extra_forbidden", "unknown key", listed=listed)

    @property
    def is_unknown_key(self) -> bool:
        """Whether the fault is a key that does not exist."""
        return self.kind == "extra_forbidden"

    def __str__(self) -> str:
        key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in self.path).removeprefix(".")
        expected = f"expected {' or '.join(self.expected)}, " if self.expected else ""
        return f"{key or 'file'}: {expected}{self.message}"


def _message(detail: Any) -> str:
    match detail["type"]:
        case "missing":
            return "missing, but required"
        case "value_error":
            return str(detail["ctx"]["error"])
        case "json_invalid":  # the input is the whole file
            return f"not valid JSON: {detail['ctx']['error']}"
    return f"{detail['msg'][0].lower()}{detail['msg'][1:]}, got {detail['input']!r}"


def _known_keys(model: type[BaseModel], path: list[str | int]) -> list[str]:
    """The keys of the mappings at a path below `model`."""
    annotations: list[Any] = [model]
    for part in path:
        annotations = [below for annotation in annotations for below in _below(annotation, part)]
    models = [member for annotation in annotations for member in _members(annotation) if _is_model(member)]
    return [field.alias or name for submodel in models for name, field in submodel.model_fields.items()]


def _below(annotation: Any, part: str | int) -> Iterator[Any]:
    """The types of a value's part: of a model's field, a mapping's value or a list's item."""
    for member in _members(annotation):
        if _is_model(member):
            yield from (field.annotation for name, field in member.model_fields.items() if part in (field.alias, name))
        elif issubclass(get_origin(member) or object, Mapping):
            yield from get_args(member)[-1:]
        elif isinstance(part, int):
            yield from get_args(member)[:1]


def _members(annotation: Any) -> list[Any]:
    """The members of a union, without annotations."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _members(arguments[0])
    if origin in (Union, UnionType):
        return [member for argument in arguments for member in _members(argument)]
    return [annotation]


def _is_model(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)
