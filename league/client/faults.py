"""From what a server answers to the LeagueError that says so."""

import httpx

from league.client.patience import asked_for, told
from league.errors import BY_CODE, InvalidInput, LeagueError, RateLimited, RemoteError


def fault(reply: httpx.Response, where: str) -> LeagueError:
    """The error that a reply is; one that is no JSON object with `code` and `message` is not of a server of ours."""
    document = told(reply)
    if document is None or "code" not in document or "message" not in document:
        return RemoteError(f"{where} answered {reply.status_code}: {reply.text[:200]}")
    kind = BY_CODE.get(document["code"])
    if kind is RateLimited:
        return RateLimited(document["message"], asked_for(reply))
    return (kind or (InvalidInput if reply.status_code < 500 else RemoteError))(document["message"])
