"""Faults injected into the text of a module."""

import importlib
import sys
from pathlib import Path
from types import ModuleType

import pytest


def with_fault(
    monkeypatch: pytest.MonkeyPatch, module: str, old: str, new: str, wanted: str, package: str
) -> ModuleType:
    """Import the module `wanted` again after a replacement in the text of `module`.

    All modules of `package` are imported again. `monkeypatch` restores all of them.
    """
    original = importlib.import_module(module)
    source = Path(str(original.__file__)).read_text()
    assert source.count(old) == 1, f"{old!r} occurs {source.count(old)} times in {module}"
    importlib.import_module(wanted)
    for name in {module, *(name for name in sys.modules if name.startswith(f"{package}."))}:
        parent, _, leaf = name.rpartition(".")
        # Imports set this attribute again.
        monkeypatch.setattr(sys.modules[parent], leaf, sys.modules[name])
        monkeypatch.delitem(sys.modules, name)
    faulty = ModuleType(module)
    monkeypatch.setitem(sys.modules, module, faulty)
    monkeypatch.setattr(sys.modules[module.rpartition(".")[0]], module.rpartition(".")[2], faulty)
    exec(compile(source.replace(old, new), f"{module} with a fault", "exec"), faulty.__dict__)
    return importlib.import_module(wanted)
