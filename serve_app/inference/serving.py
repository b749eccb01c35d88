"""What all interfaces of inference of a replica share."""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import perf_counter_ns

from league.errors import Overloaded
from league.policies.policy import Actions, Arrays
from serve_app.access.access_control import AccessControl
from serve_app.live_versions.alias_slots import AliasSlots
from serve_app.live_versions.policies import ActionOptions, LoadedPolicy
from serve_app.live_versions.resolver import ModelResolver
from serve_app.live_versions.shadow import Shadow
from serve_app.live_versions.traffic_split import TrafficSplit
from serve_app.observability.metrics import Metrics
from serve_app.settings import ServeSettings


@dataclass(frozen=True, slots=True)
class Serving:
    """Finds policies, runs them, mirrors requests to shadows, and counts. All methods run on the event loop.

    An `api` is the name of an interface in metrics.
    """

    models: ModelResolver
    slots: AliasSlots
    traffic: TrafficSplit
    shadow: Shadow
    metrics: Metrics
    access: AccessControl
    settings: ServeSettings
    in_flight: Counter[str] = field(default_factory=Counter)
    """api → requests in flight."""

    def check_in_flight(self, api: str) -> None:
        """Raise Overloaded if as many requests of an interface are in flight as may be."""
        if self.in_flight[api] >= self.settings.max_in_flight:
            raise Overloaded(f"{self.in_flight[api]} requests are in progress in this replica")

    @contextmanager
    def admitted(self, api: str) -> Iterator[None]:
        """Count a request while it is in progress. Raises Overloaded."""
        self.check_in_flight(api)
        self.in_flight[api] += 1
        try:
            yield
        finally:
            self.in_flight[api] -= 1

    async def act(
        self, policy: LoadedPolicy, arrays: Arrays, options: ActionOptions, state: Arrays | None = None
    ) -> Actions:
        """Choose actions, and mirror the request. Arguments and errors are those of `LoadedPolicy.act`."""
        answer = await policy.act(arrays, options, state)
        self.mirror(policy, arrays, options, answer, state)
        return answer

    def mirror(
        self, policy: LoadedPolicy, arrays: Arrays, options: ActionOptions, answer: Actions, state: Arrays | None = None
    ) -> None:
        """Mirror a request that a policy has answered, if it has a shadow."""
        mirror = self.shadow.mirror_for(policy)
        if mirror is not None:
            observations = {port.name: arrays[port.name] for port in policy.observed}
            mirror(observations, state, None if policy.is_sampled(options) else answer.actions)

    def count(self, api: str, policy: LoadedPolicy, rows: int, begun: int) -> None:
        """Count an answered request. begun: a time of `perf_counter_ns`."""
        self.metrics.count_request(api, policy, rows, perf_counter_ns() - begun)
