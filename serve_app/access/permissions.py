"""The permission that a request requires: a scope, and the league that it concerns. Pure functions.

act       POST …/action, …/infer and …/play; streams
read      other GET and HEAD requests; the model repository index
evaluate  POST and DELETE of evaluations; always requires a key
promote   changes of aliases, traffic and notes, which always require a key; and any other request, so that a new
          path is protected by default
(none)    health checks, the API description, the web pages, and the permissions of the presented key
"""

from functools import lru_cache
from typing import NamedTuple

HEALTH_PREFIXES = ("/v1/health/", "/v2/health/")
PUBLIC_PATHS = ("/docs", "/openapi.json", "/", "/leagues", "/v1/key")
PAGE_PREFIXES = ("/leagues/", "/pages/")
AUDITED = ("aliases", "rollback", "traffic", "versions")
"""Paths below a league whose changes are recorded with the name of the key."""
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


PUBLIC = RequiredPermission(None, None)


def for_request(kind: str, method: str, path: str) -> RequiredPermission:
    """The permission for a request. `kind` is the ASGI scope type; `path` is relative to the root path."""
    return (_for_request if len(path) <= MAX_CACHED else _for_request.__wrapped__)(kind, method, path)


def for_rpc(rpc: str, model: str) -> RequiredPermission:
    """The permission for an RPC of GRPCInferenceService; `model` is empty if it names none."""
    return (_for_rpc if len(model) <= MAX_CACHED else _for_rpc.__wrapped__)(rpc, model)


@lru_cache(maxsize=4096)  # the same few paths recur
def _for_request(kind: str, method: str, path: str) -> RequiredPermission:
    if (path.startswith(HEALTH_PREFIXES + PAGE_PREFIXES) or path in PUBLIC_PATHS) and method in ("GET", "HEAD"):
        return PUBLIC
    league = league_of(path)
    scope = _scope(kind, method, path)
    is_change = scope == "evaluate" or (scope == "promote" and _is_below_league(path, AUDITED))
    return RequiredPermission(scope, league, league is None and path != "/v2", is_change)


@lru_cache(maxsize=4096)
def _for_rpc(rpc: str, model: str) -> RequiredPermission:
    if rpc in ("ServerLive", "ServerReady"):
        return PUBLIC
    scope = "act" if rpc == "ModelInfer" else "read"
    league = model.partition(".")[0] or None
    return RequiredPermission(scope, league, league is None and rpc != "ServerMetadata")


def _scope(kind: str, method: str, path: str) -> str:
    if kind == "websocket":
        return "act"
    if method in ("GET", "HEAD") or path == "/v2/repository/index":
        return "read"
    is_action = path.startswith("/v1/policies/") and path.endswith("/action")
    is_inference = path.startswith("/v2/models/") and path.endswith("/infer")
    if is_action or is_inference or (method == "POST" and _is_below_league(path, ("play",))):
        return "act"
    is_evaluation = method in ("POST", "DELETE") and _is_below_league(path, ("evaluations",))
    return "evaluate" if is_evaluation else "promote"


def _is_below_league(path: str, names: tuple[str, ...]) -> bool:
    """Whether a path is `/v1/leagues/L/NAME` or below it, for one of the names."""
    parts = path.split("/")
    return parts[1:3] == ["v1", "leagues"] and len(parts) > 4 and parts[4] in names


def league_of(path: str) -> str | None:
    """The league in a path: `/v1/leagues/L…`, `/v1/policies/L.policy/…`, `/v2/models/L…`."""
    _, *parts = path.split("/", 4)
    if len(parts) < 3 or tuple(parts[:2]) not in (("v1", "leagues"), ("v1", "policies"), ("v2", "models")):
        return None
    if parts == ["v2", "models", "stats"]:
        return None
    return parts[2].partition(".")[0] or None
