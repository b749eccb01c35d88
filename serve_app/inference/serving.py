"""What all interfaces of inference of a replica share."""

import asyncio
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import perf_counter_ns

from league.errors import Overloaded
from league.policies.policy import Arrays
from serve_app.access.access_control import AccessControl
from serve_app.inference.batches import Answer, Batches, GraphRun, RequestRows
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
    batches: Batches = field(default_factory=Batches)

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
        self,
        policy: LoadedPolicy,
        observations: RequestRows,
        options: ActionOptions,
        state: Arrays | None = None,
    ) -> Answer:
        """Decode the observations of a request, choose actions, and mirror the request.

        Small requests without a seed and a state share a run with those of other connections; see `Batches`.

        Args:
            policy: The policy that acts.
            observations: Those of the request. They may contain the recurrent state.
            options: How actions are chosen.
            state: The recurrent state; None at the start of episodes.

        Raises:
            LeagueError: See `LoadedPolicy.act`, and what reading the observations raises.
        """
        can_share = options.seed is None and not (policy.state or options.analysis)
        is_small = observations.is_joinable and observations.rows <= policy.inline_rows
        is_joint = can_share and is_small and policy.model not in self.settings.unbatched
        answer = await GraphRun(self.batches, policy, observations, options) if is_joint else None
        if answer is None:
            started = perf_counter_ns()
            if observations.is_large:
                inputs = await asyncio.to_thread(observations.read, policy, [observations])
            else:
                inputs = observations.read(policy, [observations])
            if state is None:
                state = {name: inputs[name] for name, _ in policy.state if name in inputs} or None
            read = perf_counter_ns()
            actions = await policy.act(inputs, options, state)
            answer = Answer(actions, inputs, slice(None), started, read, perf_counter_ns())
        if (mirror := self.shadow.mirror_for(policy)) is not None:
            inputs = answer.inputs
            greedy = None if policy.is_sampled(options) else answer.actions
            mirror({port.name: inputs[port.name] for port in policy.observed}, state, greedy)
        return answer
