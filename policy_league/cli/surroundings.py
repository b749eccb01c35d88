"""What a shell provides for a command, and a service manager, a container or an old terminal may not."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from io import TextIOWrapper

from league.errors import ConfigError, StorageError
from league.settings import Storage

THIS_MACHINE = "localhost,127.0.0.1,::1"


class Output(TextIOWrapper):
    """Standard output whose errors are StorageErrors, unless its reader has ended (BrokenPipeError)."""

    def __init__(self, original: TextIOWrapper) -> None:
        """Replace characters that the encoding of the original stream lacks."""
        super().__init__(original.buffer, original.encoding, "replace", line_buffering=original.line_buffering)
        self._original = original  # which would close the buffer at its end

    def write(self, text: str) -> int:
        """Write text to the buffer."""
        with _translated():
            return super().write(text)

    def flush(self) -> None:
        """Write the buffer."""
        with _translated():
            super().flush()


@contextmanager
def _translated() -> Iterator[None]:
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        raise StorageError(f"standard output cannot be written: {error.strerror}") from error


def complete() -> None:
    """Supply what is missing: open streams, an encoding for all text, an import path, a home directory, and for all
    libraries the rule that no proxy reaches this machine.

    Raises ConfigError without a working directory.
    """
    if type(sys.stderr) is TextIOWrapper:
        sys.stderr.reconfigure(errors="replace")
    if type(stdout := sys.stdout) is TextIOWrapper:
        sys.stdout = Output(stdout)
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            # It takes the lowest free descriptor, that of the closed stream. Otherwise a database would take it, and
            # what any library prints would be written into the database.
            stream = open(os.devnull, mode)  # noqa: SIM115  open until the process ends
            os.set_inheritable(stream.fileno(), True)
            setattr(sys, name, stream)
    name = "no_proxy" if "no_proxy" in os.environ else "NO_PROXY"
    os.environ[name] = ",".join(filter(None, (os.environ.get(name), THIS_MACHINE)))
    try:
        # A league's `entry_point` may name a module in the working directory. Ray passes the path on to its workers. It
        # is the last one, so that its files do not shadow installed packages.
        sys.path.append(os.getcwd())
    except FileNotFoundError as error:
        raise ConfigError("the working directory was removed: change to another one") from error
    if os.path.expanduser("~") == "~":
        # Ray looks for files in the home directory when it is imported.
        os.environ["HOME"] = str(Storage.from_environment().home)


def flush() -> None:
    """Write what standard output has buffered. Raises StorageError, and SystemExit if its reader has ended."""
    try:
        sys.stdout.flush()
    except (BrokenPipeError, StorageError) as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the interpreter flushes it once more
        if isinstance(error, StorageError):
            raise
        sys.exit(1)
