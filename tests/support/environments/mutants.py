"""Modules with one fault each, made by substitution in their source."""

import contextlib
import importlib
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType


@dataclass(frozen=True)
class Mutation:
    """Replaces the only occurrence of `old` in the source of `module` by `new`."""

    module: str
    old: str
    new: str


@contextlib.contextmanager
def mutated(mutation: Mutation, modules: Sequence[str]) -> Iterator[ModuleType]:
    """Yield the last of `modules`, loaded anew from a mutated source. modules: each imports only earlier ones of them.

    The original modules are restored afterwards.
    """
    originals = [importlib.import_module(name) for name in modules]
    try:
        for original in originals:
            path = Path(str(original.__file__))
            source = path.read_text()
            if original.__name__ == mutation.module:
                assert source.count(mutation.old) == 1, f"{mutation.old!r} must occur once in {mutation.module}"
                source = source.replace(mutation.old, mutation.new)
            mutant = ModuleType(original.__name__)
            _install(mutant)
            exec(compile(source, str(path), "exec"), vars(mutant))
        yield mutant
    finally:
        for original in originals:
            _install(original)


def _install(module: ModuleType) -> None:
    """Make imports find a module, in both forms: by its full name, and from its package."""
    package, _, name = module.__name__.rpartition(".")
    sys.modules[module.__name__] = module
    setattr(sys.modules[package], name, module)
