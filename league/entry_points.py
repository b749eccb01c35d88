"""Imports functions and classes of users' code by their entry points, `my_package.module:name`."""

import importlib
import os
from types import ModuleType
from typing import Any

from league.errors import ConfigError


def import_module(key: str, name: str) -> ModuleType:
    """Import a module.

    Args:
        key: What names the module, for error messages.
        name: The name of the module.

    Raises:
        ConfigError: It cannot be imported.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        searched = f"{os.getcwd()} and the installed packages were searched"
        raise ConfigError(f"{key}: cannot import {name!r}: {error}; {searched}") from error
    except Exception as error:
        if not name or name.startswith("."):
            raise ConfigError(f"{key}: {name!r} is not a valid module name") from error
        raise ConfigError(f"{key}: {name!r} fails on import: {type(error).__name__}: {error}") from error


def import_entry_point(key: str, entry_point: str) -> Any:
    """Import `module:name`.

    Args:
        key: What names the entry point, for error messages.
        entry_point: The module and the name in it.

    Raises:
        ConfigError: The module cannot be imported, or does not have the name.
    """
    module_name, _, name = entry_point.partition(":")
    module = import_module(key, module_name)
    if not hasattr(module, name):
        raise ConfigError(f"{key}: {module_name!r} ({module.__file__}) has no {name!r}")
    return getattr(module, name)
