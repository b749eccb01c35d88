"""The code that decides what happens in an environment: its source files, and the versions of libraries it imports.

Modules are found as Python would import them, but are not executed. Data files and modules whose names are computed at
run time are not found: `environment.revision` covers them.
"""

import ast
import hashlib
import sys
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from importlib import metadata
from importlib.machinery import SOURCE_SUFFIXES, FileFinder, ModuleSpec, SourceFileLoader
from importlib.util import find_spec, resolve_name
from pathlib import Path

WITHOUT_INFLUENCE = frozenset(
    {"PIL", "cv2", "farama_notifications", "imageio", "matplotlib", "pygame", "pyglet", "typing_extensions"}
)
"""Packages that show games or annotate code and do not decide results."""
_LIBRARY_FOLDERS = frozenset({"site-packages", "dist-packages"})
"""Names of the folders of libraries: of this virtual environment, of others, of the user and of the system."""


@dataclass(frozen=True, slots=True)
class EnvironmentCode:
    """The code of an environment.

    Attributes:
        source: SHA-256 of the source files that are not libraries.
        libraries: Distribution → version.
        files: Module → its source file, of those in `source`. No part of the identity.
    """

    source: str
    libraries: dict[str, str]
    files: dict[str, str] = field(default_factory=dict, compare=False)

    @property
    def exists(self) -> bool:
        """Whether the entry point was found."""
        return bool(self.files or self.libraries)


def module_in(folder: str, name: str) -> ModuleSpec | None:
    """Find a module or package in a folder, without importing it; None if the folder does not contain it."""
    spec = FileFinder(folder, (SourceFileLoader, SOURCE_SUFFIXES)).find_spec(name)
    return spec if spec is not None and spec.loader is not None else None


@cache
def environment_code(entry_point: str, folder: str | None = None) -> EnvironmentCode:
    """Return the code behind an entry point, `package.module` or `package.module:function`.

    folder: where its package is searched first, and what it imports after the installed libraries.

    It is read once per process, which also imports the environment once. Source files are the entry point's module and
    every module that it imports, directly or through others, and that does not belong to a library. Libraries are
    identified by the versions of their distributions: code without one is a source file, wherever it is. An entry point
    that does not exist has no code.
    """
    start = entry_point.partition(":")[0]
    package = start.partition(".")[0]
    is_in_folder = folder is not None and module_in(folder, package) is not None
    libraries, files, texts = dict[str, str](), dict[str, str](), dict[str, str]()
    visited_names, waiting = set[str](), [start]
    while waiting:
        name = waiting.pop()
        top = name.partition(".")[0]
        is_own = top == package and is_in_folder
        if name in visited_names or top in WITHOUT_INFLUENCE or (top in sys.stdlib_module_names and not is_own):
            continue
        visited_names.add(name)
        spec = _spec(name, folder, is_own=is_own)
        if spec is None or not spec.origin or not Path(spec.origin).is_file():
            continue
        versions = {} if is_own else _versions(top, Path(spec.origin))
        libraries |= versions
        if (versions and top != package) or not spec.origin.endswith(".py"):
            continue
        text = _text(Path(spec.origin))
        if not versions:
            files[name], texts[name] = spec.origin, text
        waiting += [name.rpartition(".")[0]] if "." in name else []
        waiting += _imports(text, name, is_package=spec.submodule_search_locations is not None)
    source = hashlib.sha256()
    for name in sorted(texts):
        source.update(f"{name}\0{texts[name]}\0".encode())
    return EnvironmentCode(source.hexdigest(), dict(sorted(libraries.items())), files)


def _text(file: Path) -> str:
    """Read a source file as Python does: in its declared encoding, without a byte order mark."""
    try:
        with tokenize.open(file) as text:
            return text.read()
    except (SyntaxError, UnicodeDecodeError):  # The module cannot be imported either.
        return file.read_text(encoding="latin-1")


def _versions(package: str, file: Path) -> dict[str, str]:
    """Return distribution → version if a top-level package, one of whose files is given, belongs to a library."""
    return {} if _LIBRARY_FOLDERS.isdisjoint(file.parts) else _distributions(package)


def _spec(name: str, folder: str | None, *, is_own: bool) -> ModuleSpec | None:
    """Find a module without importing its parents. is_own: search the folder before the libraries."""
    parent, _, _ = name.rpartition(".")
    if not parent:
        in_folder = None if folder is None else module_in(folder, name)
        if in_folder is not None and is_own:
            return in_folder
        try:
            spec = find_spec(name)
        except ValueError:  # A module without a specification, such as __main__.
            spec = None
        is_library = spec is not None and spec.origin is not None and bool(_versions(name, Path(spec.origin)))
        return spec if in_folder is None or is_library else in_folder
    above = _spec(parent, folder, is_own=is_own)
    folders = above.submodule_search_locations if above else None
    specs = (FileFinder(folder, (SourceFileLoader, SOURCE_SUFFIXES)).find_spec(name) for folder in folders or ())
    return next(filter(None, specs), None)


def _imports(text: str, module: str, *, is_package: bool) -> Iterator[str]:
    """Yield the modules that a source text imports, and names that may be modules."""
    package = module if is_package else module.rpartition(".")[0]
    try:
        tree = ast.parse(text)
    except SyntaxError:  # The module cannot be imported either.
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            try:
                origin = (
                    resolve_name("." * node.level + (node.module or ""), package) if node.level else node.module or ""
                )
            except ImportError:  # Beyond the top-level package. Code may try this, and catch the exception.
                continue
            yield origin
            yield from (f"{origin}.{alias.name}" for alias in node.names if alias.name != "*")


_packages_distributions = cache(metadata.packages_distributions)


@cache
def _distributions(package: str) -> dict[str, str]:
    """Return distribution → version of the distributions that contain a top-level package."""
    try:
        return {package: metadata.version(package)}
    except metadata.PackageNotFoundError:
        return {name: metadata.version(name) for name in _packages_distributions().get(package, ())}
