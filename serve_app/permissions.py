"""What a request needs: a scope, and the league that it is about. Pure.

act      POST …/action, …/infer, …/play; a stream
read     GET (HEAD) of anything else; the index of models
evaluate POST and DELETE of evaluations, even where no other request needs a key
promote  what changes an alias or what is written of a version, even where no other request needs a key; and whatever
         else, so that a path that nobody thought of is not the one that is open
nothing  health; the description of the server and the pages, which tell strangers nothing of a league; what a key
         may do
"""

from functools import lru_cache
from typing import NamedTuple

HEALTH = ("/v1/health/", "/v2/health/")
DESCRIPTION = ("/docs", "/openapi.json", "/", "/leagues", "/v1/key")
PAGES = ("/leagues/", "/pages/")
SIGNED = ("aliases", "rollback", "traffic", "versions")
"""What below a league is changed in somebody's name."""


class Need(NamedTuple):
    """What a key must have. No scope: no key is needed."""

    scope: str | None
    league: str | None
    """None: it is about none, or about all of them."""
    is_of_all: bool = False
    """Whether it is about all leagues."""
    is_change: bool = False
    """Whether it changes what is served, played or written: that needs a key, and so somebody's name, always."""


NOTHING = Need(None, None)


@lru_cache(maxsize=4096)  # the same few come again and again
def of_request(kind: str, method: str, path: str) -> Need:
    """What a request needs; `kind` is ASGI's, `http` or `websocket`, and `path` is below the root path."""
    if (path.startswith(HEALTH + PAGES) or path in DESCRIPTION) and method in ("GET", "HEAD"):
        return NOTHING
    league = league_of(path)
    scope = _scope(kind, method, path)
    is_change = scope == "evaluate" or (scope == "promote" and _is_below_league(path, SIGNED))
    return Need(scope, league, league is None and path != "/v2", is_change)


@lru_cache(maxsize=4096)
def of_rpc(rpc: str, model: str) -> Need:
    """What a call of gRPC's GRPCInferenceService needs; `model` is empty where it names none."""
    if rpc in ("ServerLive", "ServerReady"):
        return NOTHING
    scope = "act" if rpc == "ModelInfer" else "read"
    league = model.partition(".")[0] or None
    return Need(scope, league, league is None and rpc != "ServerMetadata")


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
    """Whether a path is `/v1/leagues/L/name`, or below it, for one of the names."""
    parts = path.split("/")
    return parts[1:3] == ["v1", "leagues"] and len(parts) > 4 and parts[4] in names


def league_of(path: str) -> str | None:
    """The league that a path names: `/v1/leagues/L…`, `/v1/policies/L.policy/…`, `/v2/models/L…`."""
    _, *parts = path.split("/", 4)
    if len(parts) < 3 or tuple(parts[:2]) not in (("v1", "leagues"), ("v1", "policies"), ("v2", "models")):
        return None
    if parts == ["v2", "models", "stats"]:
        return None
    return parts[2].partition(".")[0] or None
