"""What a person is told of a fault in a trial: one sentence that says whose code it was and where all is written."""

import re
import traceback
from pathlib import Path

from ray.exceptions import RayTaskError

import training
from league.errors import LeagueError

FRAME = re.compile(r'^\s*File "(?P<file>.+)", line (?P<line>\d+), in ', re.MULTILINE)
ROOT = Path(training.__file__).parent.parent
OURS = ("<", *(f"{ROOT}/{room}/" for room in ("league", "training", "cli")))
LIBRARIES = ("-packages/", "/lib/python")


def told(error: BaseException, league: str, trace: Path) -> LeagueError:
    """The fault behind an error of Ray's: a LeagueError as it is, anything else by its kind, its words, and the line
    of the user's code that it went through last. trace: the file that holds the whole of it."""
    causes = _causes(error)
    for cause in causes:
        if isinstance(cause, LeagueError) and not isinstance(cause, RayTaskError):
            return cause
    words = (str(causes[-1]).strip().splitlines() or [""])[0]
    place = _place(_trace(error))
    fault = f"{type(causes[-1]).__name__}: {words}" if words else type(causes[-1]).__name__
    where = f" at {place}" if place else ""
    return LeagueError(f"league {league}: training broke off with {fault}{where}; the whole trace is in {trace}")


def _causes(error: BaseException) -> list[BaseException]:
    """The error and what lies behind it: Ray keeps the exception of another process as `cause`."""
    causes: list[BaseException] = []
    behind: BaseException | None = error
    while behind is not None and behind not in causes:
        causes.append(behind)
        behind = getattr(behind, "cause", None) or behind.__cause__
    return causes


def _trace(error: BaseException) -> str:
    """The traces of all processes that the error went through, as text."""
    texts = [str(getattr(cause, "traceback_str", "")) for cause in _causes(error)]
    return "\n".join([*texts, "".join(traceback.format_exception(error))])


def _place(trace: str) -> str | None:
    """`file:line` of the last frame of a user's code in a trace, else of a library's; ours and Ray's say nothing."""
    frames = [f"{match['file']}:{match['line']}" for match in FRAME.finditer(trace) if not _is_ours(match["file"])]
    theirs = [frame for frame in frames if not any(part in frame for part in LIBRARIES)]
    return next(reversed(theirs or frames), None)


def _is_ours(file: str) -> bool:
    return file.startswith(OURS) or "-packages/ray/" in file
