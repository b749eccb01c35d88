"""Every command prints with `--json` what was recorded: see `tests.support.commands`."""

import re
from math import isclose
from typing import Any

import pytest

from tests.support.commands import documents
from tests.support.recordings import read

FLOAT = re.compile(r"-?\d+(?:\.\d+(?:e[+-]?\d+)?|e[+-]?\d+)")
ROUNDING, ROUNDING_OF_ELO = 1e-9, 1e-3
"""How much floats may differ between processors. Intervals of ratings do so in the fifth digit."""


def test_commands_print_what_was_recorded(subtests: pytest.Subtests) -> None:
    printed, recorded = dict(documents()), read("commands")
    assert printed.keys() == recorded.keys()
    for case, document in printed.items():
        text, expected = _text(document), _text(recorded[case])
        with subtests.test(case):
            if not _alike(text, expected):
                assert text == expected


def _text(document: dict[str, Any]) -> str:
    return "{stdout}\n{stderr}\nexit code {exit_code}".format(**document)


def _alike(text: str, expected: str) -> bool:
    """Whether two texts differ in the last digits of floats at most."""
    numbers = zip(FLOAT.findall(text), FLOAT.findall(expected), strict=False)
    return FLOAT.sub("", text) == FLOAT.sub("", expected) and all(_close(*map(float, pair)) for pair in numbers)


def _close(number: float, expected: float) -> bool:
    tolerance = ROUNDING_OF_ELO if abs(expected) >= 1 else ROUNDING
    return isclose(number, expected, rel_tol=tolerance, abs_tol=ROUNDING)
