"""From what a server answers to the LeagueError that says so."""

from collections.abc import Mapping
from typing import Any

from league import errors
from league.errors import InvalidInput, LeagueError, RateLimited, RemoteError

BY_CODE = {
    error.code: error for error in vars(errors).values() if isinstance(error, type) and issubclass(error, LeagueError)
}


def fault(status: int, told: Mapping[str, Any] | None, text: str, where: str) -> LeagueError:
    """The error for an answer that is none.

    told: its JSON object, `code` and `message`; None if it is no server of ours that answers. text: the answer itself.
    """
    if told is None or "code" not in told or "message" not in told:
        return RemoteError(f"{where} answered {status}: {text[:200]}")
    kind = BY_CODE.get(told["code"])
    if kind is RateLimited:
        return RateLimited(told["message"], float(told.get("retry_after", 1.0)))
    return (kind or (InvalidInput if status < 500 else RemoteError))(told["message"])
