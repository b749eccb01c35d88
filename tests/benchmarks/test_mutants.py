"""Faults that are injected into a module."""

import ast

import pytest

from benchmarks.mutants import mutants


@pytest.mark.parametrize(
    ("source", "after"),
    [
        ("a < b", ["(a <= b)"]),
        ("a and not b", ["(a or not b)", "bool(b)"]),
        ("é = '–' or x + 1", ["('–' and x + 1)", "(x - 1)", "2"]),
        ("f(True)", ["pass", "False"]),
        ("def f(a: int = 1) -> int:\n    '''One.'''\n    return a", ["2", "return None"]),
        ("def f(a: Literal[1]) -> Literal[2]:\n    pass", []),
        ("if TYPE_CHECKING:\n    import a\n    b = 1", []),
    ],
)
def test_every_fault_of_a_module_is_a_module(source: str, after: list[str]) -> None:
    faults = list(mutants("a.py", source))
    assert sorted(fault.after for fault in faults) == sorted(after)
    for fault in faults:
        mutant = (source.encode()[: fault.start] + fault.after.encode() + source.encode()[fault.end :]).decode()
        ast.parse(mutant)
        assert mutant != source
        assert source.encode()[fault.start : fault.end].decode() == fault.before
