"""The permission that a request requires: a scope, and the league that it concerns. Pure functions.

Routes declare their scopes. An unknown path requires `read` to be read, and `promote` otherwise, so that it is
protected by default.
"""

import re
from collections.abc import Iterable
from functools import lru_cache
from typing import NamedTuple

from starlette.routing import compile_path

from serve_app.declaration import EVENT_STREAM, Declaration

MAX_CACHED = 256
"""Length of the longest path or model whose permission is cached. Requests without a key are cached, too, and their
paths may have 64 kB and model names 4 MB."""


class RequiredPermission(NamedTuple):
    """The permission that a request requires. If `scope` is None, no key is needed."""

    scope: str | None
    league: str | None
    """The league that the request concerns; None for none or all of them."""
    is_of_all: bool = False
    """Whether the request concerns all leagues."""
    is_change: bool = False
    """Whether the request changes what is served, played or recorded, which always requires a key."""
    is_stream: bool = False
    """Whether the response is an event stream, which has no end of its own."""


PUBLIC = RequiredPermission(None, None)


class Permissions:
    """The permissions that declared routes require."""

    def __init__(self, declarations: Iterable[Declaration]) -> None:
        self._declared: dict[str, list[tuple[re.Pattern[str], Declaration]]] = {}
        for declaration in declarations:
            pattern, _, _ = compile_path(declaration.path)
            self._declared.setdefault(declaration.method, []).append((pattern, declaration))
        self._cached = lru_cache(maxsize=4096)(self._for_request)  # the same few paths recur

    def for_request(self, kind: str, method: str, path: str) -> RequiredPermission:
        """The permission for a request. `kind` is the ASGI scope type; `path` is relative to the root path."""
        return (self._cached if len(path) <= MAX_CACHED else self._for_request)(kind, method, path)

    def _for_request(self, kind: str, method: str, path: str) -> RequiredPermission:
        kind_of_route = "WEBSOCKET" if kind == "websocket" else "GET" if method == "HEAD" else method
        routes = self._declared.get(kind_of_route, ())
        declaration = next((declaration for pattern, declaration in routes if pattern.match(path)), None)
        league = league_of(path)
        if declaration is None:
            scope = {"WEBSOCKET": "act", "GET": "read"}.get(kind_of_route, "promote")
            return RequiredPermission(scope, league, league is None)
        if declaration.scope is None:
            return PUBLIC
        return RequiredPermission(
            declaration.scope,
            league,
            league is None and declaration.is_of_all,
            declaration.is_change,
            declaration.media == EVENT_STREAM,
        )


def for_rpc(rpc: str, model: str) -> RequiredPermission:
    """The permission for an RPC of GRPCInferenceService; `model` is empty if it names none."""
    return (_for_rpc if len(model) <= MAX_CACHED else _for_rpc.__wrapped__)(rpc, model)


@lru_cache(maxsize=4096)
def _for_rpc(rpc: str, model: str) -> RequiredPermission:
    if rpc in ("ServerLive", "ServerReady"):
        return PUBLIC
    scope = "act" if rpc == "ModelInfer" else "read"
    league = model.partition(".")[0] or None
    return RequiredPermission(scope, league, league is None and rpc != "ServerMetadata")


def league_of(path: str) -> str | None:
    """The league in a path: `/v1/leagues/L…`, `/v1/policies/L.policy/…`, `/v2/models/L…`."""
    _, *parts = path.split("/", 4)
    if len(parts) < 3 or tuple(parts[:2]) not in (("v1", "leagues"), ("v1", "policies"), ("v2", "models")):
        return None
    if parts == ["v2", "models", "stats"]:
        return None
    return parts[2].partition(".")[0] or None
