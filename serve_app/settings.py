"""The limits of a serving replica, each with what it must keep to. `args` in deploy.yaml overrides them.

What Ray Serve itself limits (replicas, requests at once, queue, drain) stands in deploy.yaml.
"""

from datetime import timedelta
from typing import Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

ACKNOWLEDGED_WITHIN = timedelta(seconds=15)
"""What a replica said longer ago counts as silence: `Registry.acknowledgements` looks back this far."""


class ServeSettings(BaseModel):
    """Times in seconds, sizes in bytes."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    max_body: int = Field(default=4 * 2**20, ge=1024)
    """A larger request body is refused with 413, and a larger message ends its stream with 1009. A replica may hold
    `max_in_flight` of them at once, and HAProxy repeats a request on another replica only if it fits into
    RAY_SERVE_HAPROXY_TUNE_BUFSIZE."""
    max_in_flight: int = Field(default=256, ge=1)
    """Requests for actions that a replica has begun and not yet answered; beyond them it answers 429."""
    max_streams: int = Field(default=1024, ge=1)
    """Streams open in a replica; one more is refused with 429."""
    max_listeners: int = Field(default=200, ge=1)
    """Streams of events open in a replica; one more is refused with 429."""
    max_batch: int = Field(default=1024, ge=1)
    """Most observations in one request."""
    timeout: float = Field(default=4.5, gt=0)
    """For one request, from its head to its reply; beyond it 504, or 408 if the body was the cause. Less than
    RAY_SERVE_HAPROXY_TIMEOUT_SERVER_S, after which HAProxy answers 500. A client may ask for less by
    `x-request-timeout-ms`."""
    max_waiting: int = Field(default=256, ge=1)
    """Requests for actions that may wait for each other on the event loop, those on connections that were not accepted
    yet among them. When more wait for longer than `patience`, those beyond are answered 429."""
    max_turn: float = Field(default=0.025, gt=0)
    """The same in time: what one turn of the event loop comes to later than that is answered 429, if its turns take
    longer for more than `patience`. Who is accepted waits for two turns at most."""
    patience: float = Field(default=0.1, ge=0)
    """How long a burst may last."""
    require_keys: Literal["auto", "always", "never"] = "auto"
    """Whether a request needs an API key. `auto`: as soon as the registry has one, and in any case where the server
    listens to other machines. `never` is what `league serve --insecure` sets. Changes of what is served need one
    always."""
    grpc_local_only: bool = True
    """Refuse gRPC from other machines. A replica's gRPC server, which is Ray Serve's, listens on all interfaces
    whatever the host is; clients call HAProxy, which is on the same machine unless a cluster has several."""
    cached_versions: int = Field(default=8, ge=1)
    """Versions kept because somebody asked for them by number. Those that an alias names are kept besides."""
    poll: float = Field(default=0.2, gt=0)
    """Between two looks at the registry's aliases. A promotion reaches every replica after at most this, plus loading;
    within a second, as promised, if poll ≤ 0.5."""
    poll_slowest: float = Field(default=5.0, gt=0)
    """The longest pause between looks while the database fails; pauses double up to it. At least `poll`."""
    poll_events: float = Field(default=0.5, gt=0)
    """Between two looks at what streams of events tell of; nobody looks while none is open."""
    heartbeat: float = Field(default=4.0, gt=0)
    """Between two acknowledgements of the same. At most a third of ACKNOWLEDGED_WITHIN: two may get lost."""
    retry: float = Field(default=3.0, gt=0)
    """How long a version that could not be loaded is not tried again; also the `Retry-After` of a 503."""
    access_log: str | None = None
    """Directory of an access log, inside LEAGUE_HOME unless it is absolute: a file of JSON lines for each replica. None
    for no log."""
    shadow_waiting: int = Field(default=1024, ge=1)
    """Requests that may wait to be mirrored to a shadow; beyond them they are not mirrored, and counted as dropped."""
    shadow_load: float = Field(default=0.1, gt=0, lt=1)
    """Share of a core that mirrored requests may take. What does not fit is dropped."""
    studio: str | None = None
    """What plays games, by import string: `evaluation.studio:deployment`, as deploy.yaml has it. None: nobody does, and
    evaluations and games are answered 503."""
    evaluation_workers: int = Field(default=1, ge=1)
    """Processes that play the matches of one evaluation. They give way to replicas, but share their cores."""
    evaluations_at_once: int = Field(default=1, ge=1)
    """Evaluations that are played at the same time; the others wait in their order."""
    max_evaluations: int = Field(default=16, ge=1)
    """Evaluations that may be queued or running, of all leagues; one more is refused with 429."""
    inline: float = Field(default=0.001, gt=0)
    """Inference that takes longer runs in a thread, so that it holds up neither other requests nor health checks."""

    @model_validator(mode="after")
    def _in_proportion(self) -> Self:
        if self.poll_slowest < self.poll:
            raise ValueError(f"poll_slowest must be at least poll ({self.poll:g})")
        if 3 * self.heartbeat > ACKNOWLEDGED_WITHIN.total_seconds():
            raise ValueError(f"heartbeat must be at most {ACKNOWLEDGED_WITHIN.total_seconds() / 3:g} s")
        return self
