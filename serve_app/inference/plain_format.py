"""What a format of requests adds to the fast path (serve_app.routes.plain_action), which batches and answers them."""

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

from league.policies.policy import Actions
from serve_app.inference.action_request import Arrays
from serve_app.live_versions.policies import ActionOptions, LoadedPolicy
from serve_app.live_versions.traffic_split import Headers
from serve_app.runtime.uvicorn_http import HttpProtocol


class Target(NamedTuple):
    """What the URL of a request names. path: below the root path. version: a number or an alias."""

    path: str
    model: str
    version: str
    is_action: bool
    """Whether it is the action route; otherwise the Open Inference Protocol."""


class PlainRequest(NamedTuple):
    """An accepted request. time: when it was admitted, in nanoseconds. content: as its format has parsed it."""

    connection: HttpProtocol
    time: int
    target: Target
    policy: LoadedPolicy
    content: Any
    rows: int
    has_key: bool


class Times(NamedTuple):
    """When the work on a batch started, and when it was read and run, in nanoseconds of `perf_counter_ns`."""

    start: int
    read: int
    ran: int


class PlainFormat(Protocol):
    """A format of requests."""

    api: str
    """Name of its route in metrics."""

    def parse(self, target: Target, headers: Headers, body: bytes, policy: LoadedPolicy) -> tuple[Any, int] | None:
        """The content and its number of rows. If it is None, the application answers, and if
        it raises JSONDecodeError, KeyError or LeagueError."""

    def read(self, policy: LoadedPolicy, contents: Sequence[Any], rows: int) -> Arrays:
        """The inputs of the graph for the contents of several requests. Raises LeagueError."""

    def options(self, contents: Sequence[Any]) -> ActionOptions:
        """How the actions of several requests are chosen."""

    def write(self, request: PlainRequest, output: Actions, rows: slice) -> tuple[bytes, bytes] | None:
        """The header lines and the body of the response; None if the application answers after all."""

    def count(self, request: PlainRequest, times: Times, is_first: bool) -> None:
        """Count an answered request beyond the metrics. is_first: of its batch."""
