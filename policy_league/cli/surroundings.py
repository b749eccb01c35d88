"""What a shell provides for a command, and a service manager, a container or an old terminal may not."""

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from io import TextIOWrapper

from league.errors import ConfigError, StorageError
from league.settings import Storage

THIS_MACHINE = "localhost,127.0.0.1,::1"


class Stream(TextIOWrapper):
    """Standard output or standard error. Characters that its encoding lacks are replaced."""

    def __init__(self, original: TextIOWrapper, handled: Callable[[], AbstractContextManager[None]]) -> None:
        """handled: the context of each write, which handles OSErrors."""
        super().__init__(original.buffer, original.encoding, "replace", line_buffering=original.line_buffering)
        self._original = original  # which would close the buffer at its end
        self._handled = handled

    def write(self, text: str) -> int:
        """Write text to the buffer."""
        with self._handled():
            super().write(text)
        return len(text)

    def flush(self) -> None:
        """Write the buffer."""
        with self._handled():
            super().flush()


@contextmanager
def _translated() -> Iterator[None]:
    try:
        yield
    except BrokenPipeError:  # its reader has ended
        raise
    except OSError as error:
        raise StorageError(f"standard output cannot be written: {error.strerror}") from error


def _ignored() -> AbstractContextManager[None]:
    return suppress(OSError)  # there is nowhere to say it


def complete() -> None:
    """Supply what is missing: open streams, an encoding for all text, an import path, a home directory, and for all
    libraries the rule that no proxy reaches this machine.

    Raises ConfigError without a working directory.
    """
    if type(sys.stdout) is TextIOWrapper:
        sys.stdout = Stream(sys.stdout, _translated)
    if type(sys.stderr) is TextIOWrapper:
        sys.stderr = Stream(sys.stderr, _ignored)
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
