"""Summarises a failed trial in one sentence: the exception, the user's line of code, and where the traceback is."""

import re
import traceback
from pathlib import Path

from ray.exceptions import RayActorError, RayTaskError

import training
from league.errors import LeagueError, one_line
from training.rllib_compat import remote_traceback

FRAME_LINE = re.compile(r'^\s*File "(?P<file>.+)", line (?P<line>\d+), in ', re.MULTILINE)
ROOT = Path(training.__file__).parent.parent
OWN_PATHS = ("<", *(f"{ROOT}/{package}/" for package in ("league", "training", "policy_league")))
LIBRARY_PATHS = ("-packages/", "/lib/python")


def training_error(error: BaseException, league: str, trace: Path) -> LeagueError:
    """Return the cause of an error from Ray as one LeagueError.

    A LeagueError is returned as it is; for others the message contains the type, the text, the last line of the user's
    code in the traceback, and the notes of the exception. trace: the file with the complete traceback.
    """
    causes = _causes(error)
    for cause in causes:
        if isinstance(cause, LeagueError) and not isinstance(cause, RayTaskError):
            return cause
    place = _user_frame(_full_traceback(error))
    fault = one_line(causes[-1], with_type=True, first_line=True)
    where = " ".join(["", *(["at " + place] if place else []), *getattr(causes[-1], "__notes__", [])])
    return LeagueError(f"league {league}: training failed with {fault}{where}; see the traceback in {trace}")


def is_process_lost(error: BaseException) -> bool:
    """Return whether the cause of an error is that a process of Ray ended or cannot be reached."""
    return any(isinstance(cause, RayActorError) for cause in _causes(error))


def _causes(error: BaseException) -> list[BaseException]:
    """Return the error and its causes. Ray stores the exception of another process as `cause`."""
    causes: list[BaseException] = []
    current: BaseException | None = error
    while current is not None and current not in causes:
        causes.append(current)
        current = getattr(current, "cause", None) or current.__cause__
    return causes


def _full_traceback(error: BaseException) -> str:
    """Return the tracebacks of all processes that the error passed through."""
    texts = [remote_traceback(cause) for cause in _causes(error)]
    return "\n".join([*texts, "".join(traceback.format_exception(error))])


def _user_frame(trace: str) -> str | None:
    """Return `file:line` of the last frame in the user's code, otherwise in a library; own code and Ray are skipped."""
    frames = [
        f"{match['file']}:{match['line']}" for match in FRAME_LINE.finditer(trace) if not _is_own_code(match["file"])
    ]
    theirs = [frame for frame in frames if not any(part in frame for part in LIBRARY_PATHS)]
    return next(reversed(theirs or frames), None)


def _is_own_code(file: str) -> bool:
    return file.startswith(OWN_PATHS) or "-packages/ray/" in file
