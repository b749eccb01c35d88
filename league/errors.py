"""The exceptions, which the client raises too, and what only the program does with them."""

import sysconfig
import traceback
from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from pathlib import Path
from types import TracebackType
from typing import Any

import policy_league_client
from policy_league_client.errors import *
from policy_league_client.errors import BY_CODE, LeagueError, one_line

_INSTALLED = tuple(sysconfig.get_path(kind) for kind in ("stdlib", "purelib", "platlib"))
OWN_PACKAGES = {
    package: f"{Path(__file__).parents[1] / package}/"
    for package in ("evaluation", "league", "policy_league", "serve_app", "training")
} | {"policy_league_client": f"{Path(policy_league_client.__file__).parent}/"}
"""Package of this project → its folder, with a slash at the end."""


class ExitCalled(Exception):
    """SystemExit of a user's code, as `sys.exit()` raises it in a game whose window closes."""


class _NoExit:
    """Turns SystemExit into ExitCalled: code of a user that ends must not end a process of ours. Without state."""

    def __enter__(self) -> None:
        pass

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # Ray's handlers of SIGTERM exit wherever the process is.
        if isinstance(error, SystemExit) and raised_by(error)[0] != "ray":
            code = "" if error.code is None else repr(error.code)
            raise ExitCalled(f"sys.exit({code}) was called").with_traceback(trace) from error


no_exit = _NoExit()


def raised_by(error: BaseException) -> tuple[str, str]:
    """Return the package that raised an error that was caught, and where, as `FILE, line N`.

    Where a package is installed does not say whose it is: environments are stacked, and users have folders of their
    own.
    """
    *_, (frame, line) = traceback.walk_tb(error.__traceback__)
    return str(frame.f_globals.get("__name__")).partition(".")[0], f"{frame.f_code.co_filename}, line {line}"


def raised_at(error: BaseException) -> str | None:
    """Return where the user's code raised an error, as `FILE, line N`."""
    return last_of_user((frame.filename, frame.lineno) for frame in traceback.extract_tb(error.__traceback__))


def last_of_user(lines: Iterable[tuple[str, int | str | None]]) -> str | None:
    """Return the last line outside of the Python installation and of this project, as `FILE, line N`.

    lines: files and numbers of lines.
    """
    outside = [line for line in lines if not line[0].startswith((*_INSTALLED, "<", *OWN_PACKAGES.values()))]
    return "{}, line {}".format(*outside[-1]) if outside else None


def cause(error: BaseException) -> str:
    """Return where an exception was raised, its type and its message, to follow a statement: ` (FILE, line N): …`."""
    where = raised_at(error)
    return f"{f' ({where})' if where else ''}: {one_line(error, with_type=True)}"


def last_line(text: str) -> str:
    """Return the last line that is not blank, or an empty string."""
    return next((line.strip() for line in reversed(text.splitlines()) if line.strip()), "")


def to_document(error: LeagueError) -> dict[str, str]:
    """Return an error as data, for another process or the database."""
    return {"code": error.code, "message": str(error)}


def from_document(document: Mapping[str, Any]) -> LeagueError:
    """Return the error that `to_document` returned the data of."""
    return BY_CODE[document["code"]](document["message"])


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return `, did you mean 'steps'?`, or nothing if no known name is similar."""
    return "".join(f", did you mean {similar!r}?" for similar in get_close_matches(name, list(known), n=1))
