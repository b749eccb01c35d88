"""Settings of the service. Limits of Ray Serve itself are in deploy.yaml."""

import re
from ipaddress import ip_address
from typing import Literal, Self

from pydantic import Field, field_validator, model_validator

from league.config.base import Part
from league.policies.policy import MAX_BATCH
from league.registry.replicas import LIVENESS_TIMEOUT

OWN_PATHS = frozenset(("docs", "leagues", "metrics", "openapi.json", "pages", "v1", "v2"))
"""First segments of this server's paths."""


def is_exposed(host: str) -> bool:
    """Whether a listening address accepts connections from other machines."""
    if host == "localhost":
        return False
    try:
        return not ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return True  # a host name may resolve to any interface


class ServeSettings(Part):
    """Settings of the service. Times are in seconds, sizes in bytes."""

    root_path: str = ""
    """Path below which a proxy serves this server, such as `/ai`. The proxy may leave it in the paths of requests, or
    remove it."""
    cors_origins: list[str] = Field(default=[])
    """Origins such as `https://game.example` whose pages may call this server from a browser. All requests then need an
    API key, which such a page sends like any client, or for a stream as a WebSocket subprotocol."""
    max_body: int = Field(default=4 * 2**20, ge=1024)
    """Larger request bodies are refused with 413, and larger messages close their stream with 1009. A replica may hold
    `max_in_flight` bodies at once, and HAProxy retries a request on another replica only if it fits into
    RAY_SERVE_HAPROXY_TUNE_BUFSIZE."""
    max_incomplete: int = Field(default=32 * 2**20, ge=1024)
    """Bytes of incomplete messages of all streams of a replica; a stream that exceeds them is closed with 1013."""
    max_in_flight: int = Field(default=256, ge=1)
    """Inference requests in flight per replica, and likewise other HTTP requests; further ones are refused with 429."""
    max_streams: int = Field(default=10_000, ge=1)
    """Open streams per replica, at most three quarters of its file descriptors; further ones are refused with 429."""
    max_listeners: int = Field(default=200, ge=1)
    """Open event streams per replica; further ones are refused with 429."""
    max_streams_per_key: int = Field(default=2500, ge=1)
    """Open streams of one API key per replica; further ones are refused with 429."""
    max_listeners_per_key: int = Field(default=50, ge=1)
    """Open event streams of one API key per replica; further ones are refused with 429."""
    max_batch: int = Field(default=MAX_BATCH, ge=1)
    """Maximum observations in one request."""
    unbatched: list[str] = Field(default=[])
    """Models whose requests are never run together with those of other callers: `{league}`, or `{league}.{policy}` if
    its versions have several policies."""
    timeout: float = Field(default=4.5, gt=0)
    """Timeout of a request, from its head to its response: 504, or 408 if the body did not arrive. Must be less than
    RAY_SERVE_HAPROXY_TIMEOUT_SERVER_S, after which HAProxy responds itself. Clients can request a shorter timeout
    with `x-request-timeout-ms`."""
    run_timeout: float = Field(default=3.0, gt=0)
    """How long a run of a policy's graph may occupy a thread of the replica. It is then ended, after its current
    operator, and the request gets 504. Less than `timeout`, so that the request is not answered before."""
    max_wait: float = Field(default=0.5, gt=0)
    """How long an inference request may wait for others before it starts, nearly; those that would wait for longer are
    refused with 429."""
    require_keys: Literal["auto", "always", "never"] = "auto"
    """Whether requests need an API key. `auto`: if the registry has a key, or the server listens to other machines.
    `never` is set by `league serve --insecure`. Changes of what is served always need a key."""
    grpc_local_only: bool = True
    """Refuse gRPC calls from other machines. Ray Serve's gRPC server in a replica listens on all interfaces regardless
    of the host; clients call HAProxy, which runs on the same machine unless the cluster has several."""
    cached_versions: int = Field(default=8, ge=1)
    """Versions kept in memory after requests by number, in addition to those that aliases name."""
    load_timeout: float = Field(default=60.0, gt=0)
    """How long an alias waits for its version to be loaded; then it keeps the previous one, and the timeout is reported
    as a fault. A load that succeeds later still takes effect."""
    poll: float = Field(default=0.2, gt=0)
    """Interval between polls of the registry's change counter with SQLite. A promotion reaches every replica after at
    most this plus loading time; within one second if poll ≤ 0.5. PostgreSQL notifies replicas of changes."""
    poll_slowest: float = Field(default=2.0, gt=0)
    """Maximum interval while the database fails; the interval doubles up to it. At least `poll`."""
    poll_events: float = Field(default=0.5, gt=0)
    """Interval between polls for event streams; nothing is polled while none is open."""
    heartbeat: float = Field(default=4.0, gt=0)
    """Interval between signs of life. At most a third of LIVENESS_TIMEOUT, so that two may be lost."""
    retry: float = Field(default=3.0, gt=0)
    """How long a version that failed to load is not tried again; also the `Retry-After` of a 503."""
    access_log: str | None = None
    """Directory of the access log, relative to LEAGUE_HOME unless absolute: one file of JSON lines per replica. None
    disables it."""
    shadow_waiting: int = Field(default=1024, ge=1)
    """Requests that may wait to be mirrored; further ones are not mirrored, and counted as dropped."""
    shadow_load: float = Field(default=0.1, gt=0, lt=1)
    """Share of a core for mirrored requests. The excess is dropped."""
    evaluation_service: str | None = None
    """Import string of the evaluation service; deploy.yaml sets `evaluation.service.deployment:deployment`.
    None: no evaluation service; requests for evaluations and games get 503."""
    evaluation_workers: int = Field(default=1, ge=1)
    """Processes that play the matches of one evaluation. They have a lower priority than replicas, but share their
    cores."""
    evaluations_at_once: int = Field(default=1, ge=1)
    """Evaluations that run at the same time; others are queued."""
    max_evaluations: int = Field(default=16, ge=1)
    """Evaluations that may be queued or running in all leagues; further ones are refused with 429."""
    max_evaluations_per_league: int = Field(default=8, ge=1)
    """Evaluations of one league that may be queued or running; further ones are refused with 429."""
    search_service: str | None = None
    """Import string of the search service; deploy.yaml sets `evaluation.service.search_service:deployment`. None: no
    search service; search versions are not served, and requests for them get 503."""
    search_processes: int = Field(default=1, ge=1)
    """Maximum processes of the search service, which are started as calls wait. They have a lower priority than
    replicas, but share their cores."""
    inline: float = Field(default=0.001, gt=0)
    """Inference that takes longer runs in a thread, so that it delays neither other requests nor health checks."""

    @field_validator("root_path")
    @classmethod
    def _is_a_prefix(cls, path: str) -> str:
        if not re.fullmatch(r"(/[\w.~-]+)*", path, re.ASCII):
            raise ValueError(f"expected a path like /ai without a slash at its end, got {path!r}")
        if path.split("/")[1:2] and path.split("/")[1] in OWN_PATHS:
            raise ValueError(f"{path!r} begins like a path of this server: {', '.join(sorted(OWN_PATHS))}")
        return path

    @field_validator("cors_origins")
    @classmethod
    def _are_origins(cls, origins: list[str]) -> list[str]:
        for origin in origins:
            if not re.fullmatch(r"https?://([a-z0-9.-]+|\[[0-9a-f:.]+\])(:[0-9]{1,5})?", origin):
                raise ValueError(f"expected an origin like https://game.example:8443 in lower case, got {origin!r}")
        return origins

    @model_validator(mode="after")
    def _in_proportion(self) -> Self:
        if self.cors_origins and self.require_keys == "never":
            raise ValueError("cors_origins needs API keys, but require_keys is never: any page could use this server")
        if self.poll_slowest < self.poll:
            raise ValueError(f"poll_slowest must be at least poll ({self.poll:g})")
        if 3 * self.heartbeat > LIVENESS_TIMEOUT.total_seconds():
            raise ValueError(f"heartbeat must be at most {LIVENESS_TIMEOUT.total_seconds() / 3:g} s")
        return self
