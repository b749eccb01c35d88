"""Errors of a configuration in one line, with the keys and the expected values."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

from pydantic import ValidationError
from pydantic_core import from_json

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


def describe_yaml_error(error: Exception) -> str:
    """Return why a file is not YAML, and the line. PyYAML also raises ValueError and RecursionError."""
    import yaml  # manifests are described without it

    if isinstance(error, yaml.MarkedYAMLError) and error.problem_mark is not None and error.problem:
        return f"line {error.problem_mark.line + 1}: not valid YAML: {error.problem}"
    return f"not a YAML file: {one_line(error)}"


def describe_validation_error(error: ValidationError, document: Any) -> str:
    """Return the first faults as a sentence that names the keys and the expected values.

    document: what was validated; JSON as a text.
    """
    if isinstance(document, str | bytes):
        with suppress(ValueError):
            document = from_json(document)
    # A value that has none of several types is one fault, unless one of them says more.
    faults: dict[str, tuple[str, list[str]]] = {}
    for detail in error.errors():
        key, message = _key(detail, document), _message(detail)
        expected = TYPES.get(detail["type"]) or (detail["type"] == "literal_error" and detail["ctx"]["expected"])
        if not expected:
            faults[key] = message, []
        elif key not in faults:
            faults[key] = message, [expected]
        elif expected not in (types := faults[key][1]) and types:
            types.append(expected)
    sentences = [
        f"{key or 'file'}: {'expected ' * bool(types)}{' or '.join(types)}{', ' * bool(types)}{message}"
        for key, (message, types) in faults.items()
        # A collection with a faulty item has no fault of its own.
        if not any(other != key and other.startswith((f"{key}.", f"{key}[")) for other in faults)
    ]
    return "; ".join(sentences[:SHOWN])


def _key(detail: Any, document: Any) -> str:
    """Return the keys and indices of an error. Pydantic also names the members of unions that it has tried."""
    key, part = "", document
    for number, name in enumerate(detail["loc"], 1):
        if isinstance(name, int):
            is_item = isinstance(part, Sequence) and name < len(part)
            key, part = f"{key}[{name}]", part[name] if is_item else None
        elif isinstance(part, Mapping) and name in part:
            key, part = f"{key}.{name}", part[name]
        elif number == len(detail["loc"]) and detail["type"] in ("missing", "unknown_key"):
            key = f"{key}.{name}"
    return key.removeprefix(".")


def _message(detail: Any) -> str:
    match detail["type"]:
        case "missing":
            return "missing, but required"
        case "unknown_key":
            return str(detail["msg"])
        case "value_error":
            return str(detail["ctx"]["error"])
        case "json_invalid":  # the input is the whole file
            return f"not valid JSON: {detail['ctx']['error']}"
        case kind if kind in TYPES or kind == "literal_error":
            return f"got {detail['input']!r}"
    return f"{detail['msg'][0].lower()}{detail['msg'][1:]}, got {detail['input']!r}"
