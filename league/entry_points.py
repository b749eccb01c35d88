"""Imports functions and classes of users' code by their entry points, `my_package.module:name`.

The first part of the name is searched in the league's folder, which is by default that of its file, before it is
searched as Python does. What the user's code imports is found in installed packages first, then in that folder, and
then in the working directory, so that a file in them cannot replace a library.
"""

import importlib
import os
import sys
from collections.abc import Iterable, Sequence
from importlib.util import module_from_spec
from pathlib import Path
from types import ModuleType
from typing import Any

from league.environment_code import environment_code, module_in
from league.errors import OWN_PACKAGES, ConfigError, did_you_mean, no_exit, raised_at

_folders: list[str] = []


def search_in(folder: str) -> None:
    """Search entry points in a league's folder, for as long as this process lives."""
    if folder not in _folders:
        _folders.append(folder)
    if folder not in sys.path:
        # The command appends its working directory, which may contain modules of another league.
        sys.path.insert(len(sys.path) - (sys.path[-1:] == [os.getcwd()]), folder)


def import_module(key: str, name: str, folder: str | None = None) -> ModuleType:
    """Import a module.

    Args:
        key: What names the module, for error messages.
        name: The name of the module.
        folder: The folder to search first. None: those of all leagues that this process has read.

    Raises:
        ConfigError: It cannot be imported, or another module of the same name has been.
    """
    folders = _folders if folder is None else [folder]
    try:
        _check_name(key, name, folders)
        _check_files(key, name, folder)
        with no_exit:
            _import_own(key, name.partition(".")[0], folders)
            module = importlib.import_module(name)
        _check_files(key, name, folder)
        return module
    except ConfigError:
        raise
    except ImportError as error:
        _check_name(key, error.name or "", [*folders, os.getcwd()])
        working = [os.getcwd()] if {os.getcwd(), ""} & set(sys.path) else []
        searched = ", ".join(dict.fromkeys([*folders, *working, "installed packages"]))
        raise ConfigError(f"{key}: cannot import {name!r}: {_reason(error)}; searched: {searched}") from error
    except Exception as error:
        if not name or name.startswith("."):
            raise ConfigError(f"{key}: {name!r} is not a valid module name") from error
        raise ConfigError(f"{key}: {name!r} fails on import: {type(error).__name__}: {_reason(error)}") from error


def import_entry_point(key: str, entry_point: str, folder: str | None = None) -> Any:
    """Import `module:name`.

    Args:
        key: What names the entry point, for error messages.
        entry_point: The module and the name in it.
        folder: See `import_module`.

    Raises:
        ConfigError: The module cannot be imported, or does not have the name.
    """
    module_name, _, name = entry_point.partition(":")
    module = import_module(key, module_name, folder)
    if not hasattr(module, name):
        raise ConfigError(f"{key}: {missing(module, name)}")
    return getattr(module, name)


def missing(module: ModuleType, name: str) -> str:
    """`'game' (/home/ann/game.py) has no 'make_en', did you mean 'make_env'?`"""
    place = getattr(module, "__file__", "built in")
    return f"{module.__name__!r} ({place}) has no {name!r}{did_you_mean(name, vars(module))}"


def _check_name(key: str, name: str, folders: Iterable[str]) -> None:
    """Raise ConfigError if a module of the user is hidden by a package of this project, such as `training`."""
    package = name.partition(".")[0]
    for folder in folders if package in OWN_PACKAGES else ():
        module, path = Path(folder, *name.split(".")), Path(folder, package)
        if module.is_dir() or module.with_suffix(".py").is_file():
            path = path if path.is_dir() else path.with_suffix(".py")
            if not path.samefile(OWN_PACKAGES[package]):
                raise ConfigError(f"{key}: {path} has the name of a package of Policy League: rename it")


def _check_files(key: str, name: str, folder: str | None) -> None:
    """Raise ConfigError if this process has imported another file than that of the league, for it or what it imports.

    Modules of several leagues have the same name, for example. A process can import only one of them.
    """
    if folder is None or module_in(folder, name.partition(".")[0]) is None:
        return
    for module, file in environment_code(name, folder).files.items():
        _check_name(key, module, [folder])
        loaded = getattr(sys.modules.get(module), "__file__", None)
        if loaded is not None and os.path.realpath(loaded) != os.path.realpath(file):
            raise ConfigError(_several(key, module, (file, loaded)))


def _several(key: str, module: str, files: Iterable[str]) -> str:
    return (
        f"{key}: {module!r} is the name of several modules, {' and '.join(files)}: rename all but one, or name a single"
        " league in the command"
    )


def _import_own(key: str, package: str, folders: Sequence[str]) -> None:
    """Import a top-level module or package if one of the folders contains it."""
    specs = {os.path.realpath(str(spec.origin)): spec for folder in folders if (spec := module_in(folder, package))}
    present = sys.modules.get(package)
    loaded = getattr(present, "__file__", None)
    files = dict.fromkeys([*specs, *([os.path.realpath(loaded)] if loaded and specs else [])])
    if len(files) > 1:
        raise ConfigError(_several(key, package, files))
    if not specs or present is not None:
        return
    (spec,) = specs.values()
    module = module_from_spec(spec)
    sys.modules[package] = module
    try:
        assert spec.loader is not None
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[package]
        raise


def _reason(error: Exception) -> str:
    """The message of an exception, with the line of the user's code that raised it."""
    place = raised_at(error)
    return f"{error} ({place})" if place else str(error)
