"""Errors of a configuration in one line, with the key, the expected value and similar known keys."""

import difflib
from typing import Any, get_args, get_origin

import yaml
from pydantic import BaseModel, ValidationError

from league.config.algorithms import ALGORITHMS
from league.config.schedules import SCHEDULE_FORMS
from league.errors import one_line

RENAMED_KEYS = {"copies": "num_envs"}
"""Former key → current key."""


def describe_yaml_error(error: yaml.YAMLError | UnicodeDecodeError) -> str:
    """Return why a file is not YAML, and the line."""
    if isinstance(error, yaml.MarkedYAMLError) and error.problem_mark is not None and error.problem:
        return f"line {error.problem_mark.line + 1}: not valid YAML: {error.problem}"
    return f"not a YAML file: {one_line(error)}"


def describe_validation_error(model: type[BaseModel], error: ValidationError) -> str:
    """Return the first errors as a sentence that names the keys and the expected values."""
    return "; ".join(_describe_one(model, detail) for detail in error.errors()[:3])


def _describe_one(model: type[BaseModel], detail: Any) -> str:
    path, known_by = [str(part) for part in detail["loc"]], model
    if path[:1] == ["training"] and len(path) > 1 and path[1] in ALGORITHMS:
        # Pydantic includes the member of the union in the path.
        known_by = ALGORITHMS[path.pop(1)]
        path = [part for part in path if part not in SCHEDULE_FORMS]
    key = ".".join(path) or "file"
    match detail["type"]:
        case "missing":
            return f"{key}: missing, but required"
        case "extra_forbidden" if path[-1] in RENAMED_KEYS:
            return f"{key}: this key has been renamed to {RENAMED_KEYS[path[-1]]!r}"
        case "extra_forbidden":
            known = _known_keys(known_by, path[:-1] if known_by is model else path[1:-1])
            guess = difflib.get_close_matches(path[-1], known, n=1)
            hint = f"did you mean {guess[0]!r}?" if guess else f"expected one of {', '.join(sorted(known))}"
            return f"{key}: unknown key, {hint}"
        case "union_tag_invalid":
            return f"{key}.algorithm: expected one of {', '.join(ALGORITHMS)}, got {detail['ctx']['tag']!r}"
        case "value_error":
            return f"{key}: {detail['ctx']['error']}"
    expected = detail["msg"][0].lower() + detail["msg"][1:]
    return f"{key}: {expected}, got {detail['input']!r}"


def _known_keys(model: type[BaseModel], path: list[str]) -> list[str]:
    for part in path:
        if part.isdigit():
            continue  # the index of a list whose item model is already current
        fields = {field.alias or name: field for name, field in model.model_fields.items()}
        annotation = fields[part].annotation if part in fields else None
        while get_origin(annotation) is not None and get_args(annotation):
            annotation = get_args(annotation)[0]
        if not (isinstance(annotation, type) and issubclass(annotation, BaseModel)):
            return []
        model = annotation
    return [field.alias or name for name, field in model.model_fields.items()]
