"""The token of a local Ray, without which its ports refuse to execute code.

Ray would keep one token for all local Rays of a user in `~/.ray/auth_token`, which it creates readable by everybody.
"""

import os
import secrets
from importlib import import_module
from typing import Any

MODE, TOKEN, TOKEN_FILE = "RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"
"""Ray's environment variables."""
DISABLED = "disabled"
_variables: dict[str, str] = {}
"""What this process has set, and its values."""


def create_token() -> None:
    """Give the Ray that this process starts next a token of its own, unless the user chose one, or none.

    It is in the environment, which only processes of the same user can read and the processes of this one inherit.
    """
    if MODE not in os.environ:
        os.environ[MODE] = _variables[MODE] = "token"
    if os.environ[MODE] == DISABLED or TOKEN_FILE in os.environ or TOKEN in os.environ:
        return
    os.environ[TOKEN] = _variables[TOKEN] = secrets.token_hex(32)
    _reload()


def forget_token() -> None:
    """Forget the token of a Ray that this process has started and stopped. A cluster has another one, or none."""
    for name, value in _variables.items():
        if os.environ.get(name) == value:
            del os.environ[name]
    if _variables:
        _variables.clear()
        _reload()


def _reload() -> None:
    raylet: Any = import_module("ray._raylet")
    raylet.Config.initialize("")  # reads the mode
    raylet.AuthenticationTokenLoader.instance().reset_cache()
