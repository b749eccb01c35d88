"""A replica's application, without Ray."""

from starlette.testclient import TestClient

from league.errors import NoEvaluationService
from league.registry.registry import Registry
from league.service_requests import GameRequest, GameResponse
from league.settings import Storage
from serve_app.app import Replica
from serve_app.settings import ServeSettings
from tests.support.servers.direct_streams import DirectStreams

QUICK = ServeSettings(
    poll=0.03,
    poll_slowest=0.05,
    retry=0.05,
    heartbeat=0.2,
    max_body=64 * 1024,
    max_batch=8,
    timeout=120.0,
    run_timeout=60.0,
    max_wait=60.0,
)
"""Settings of a replica for tests: short intervals, low limits, and patience: on a busy machine a healthy request may
take longer than users wait."""
READ_ONLY = QUICK.model_copy(update={"poll": 1.0, "poll_slowest": 1.0, "heartbeat": 2.0})
"""Settings of a replica that many tests share and none changes: fast polls would slow down all tests of the process."""
LOCALHOST = "http://localhost"
"""Base URL of requests in this process: a server without keys accepts no other host."""


def local_client(server: Replica) -> TestClient:
    """A client of a replica in this process; enter it to start the replica."""
    # TestClient ignores the base URL for WebSockets, hence the header.
    return TestClient(DirectStreams(server.application()), base_url=LOCALHOST, headers={"host": "localhost"})


def replica(storage: Storage, settings: ServeSettings = QUICK) -> TestClient:
    """The application of a new replica; enter it to start."""
    server = Replica(Registry.open(storage), settings, "replica-1", evaluation_client=UnavailableEvaluation())
    return local_client(server)


class UnavailableEvaluation:
    """An evaluation service that does not respond."""

    def notify(self) -> None:
        """Do nothing."""

    async def request_game(self, request: GameRequest) -> GameResponse:
        """Raise NoEvaluationService."""
        raise NoEvaluationService("nobody is at work")
