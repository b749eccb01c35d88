"""Summarises a failed trial in one sentence: the exception, the user's line of code, and where the traceback is."""

import re
import traceback
from pathlib import Path

from ray.exceptions import RayActorError, RayTaskError

from league.errors import OWN_PACKAGES, LeagueError, one_line
from training.learners.ranks import LearnerLost
from training.rllib_compat import remote_traceback

FRAME_LINE = re.compile(r'^\s*File "(?P<file>.+)", line (?P<line>\d+), in ', re.MULTILINE)
LIBRARY_PATHS = ("-packages/", "/lib/python")
RAY_PATH = "-packages/ray/"


def training_error(error: BaseException, league: str, trace: Path) -> LeagueError:
    """Return the cause of an error from Ray as one LeagueError.

    A LeagueError is returned as it is; for others the message contains the type, the text, the last line of the user's
    code in the traceback, and the notes of the exception. trace: the file with the complete traceback.
    """
    causes = _causes(error)
    for cause in causes:
        if isinstance(cause, LeagueError) and not isinstance(cause, RayTaskError):
            return cause
    # The traceback of each process that the error passed through.
    tracebacks = [*(remote_traceback(cause) for cause in causes), "".join(traceback.format_exception(error))]
    frames = [
        f"{match['file']}:{match['line']}"
        for match in FRAME_LINE.finditer("\n".join(tracebacks))
        if not match["file"].startswith(("<", *OWN_PACKAGES.values())) and RAY_PATH not in match["file"]
    ]
    # The last frame in the user's code, otherwise in a library.
    theirs = [frame for frame in frames if not any(part in frame for part in LIBRARY_PATHS)]
    place = next(reversed(theirs or frames), None)
    fault = one_line(causes[-1], with_type=True, first_line=True)
    where = " ".join(["", *(["at " + place] if place else []), *getattr(causes[-1], "__notes__", [])])
    return LeagueError(f"league {league}: training failed with {fault}{where}; see the traceback in {trace}")


def is_process_lost(error: BaseException) -> bool:
    """Return whether the cause of an error is that a process of Ray ended or cannot be reached."""
    return any(isinstance(cause, RayActorError | LearnerLost) for cause in _causes(error))


def _causes(error: BaseException) -> list[BaseException]:
    """Return the error and its causes. Ray stores the exception of another process as `cause`."""
    causes: list[BaseException] = []
    current: BaseException | None = error
    while current is not None and current not in causes:
        causes.append(current)
        current = getattr(current, "cause", None) or current.__cause__
    return causes
