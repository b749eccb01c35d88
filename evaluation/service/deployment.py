"""Ray Serve deployment of the evaluation service: evaluations, replays and human play, and snapshots for the web pages.

deploy.yaml refers to it by import string; replicas of the policy server call it by handle and never import it. It
keeps no state of its own: evaluations and their progress are in the registry, and each request contains the whole game
of a person. It can therefore be killed and restarted at any time. Environments run in subprocesses only.

It runs only while it is needed: Ray Serve starts it at the first call, and stops it some time after the last call has
returned. Replicas of the policy server call `work` if there is something to do.
"""

import asyncio
from dataclasses import asdict
from typing import Any

POLL = 2.0
"""Seconds between two questions whether there is something to do."""


class EvaluationService:
    """The only replica of the deployment. LEAGUE_HOME and related variables locate its leagues."""

    def __init__(self, workers: int, at_once: int) -> None:
        import ray

        from evaluation.service.evaluation_supervisor import EvaluationSupervisor
        from evaluation.service.game_worker_pool import GameWorkerPool
        from evaluation.service.snapshot_refresher import SnapshotRefresher
        from league.registry.registry import Registry
        from league.settings import Storage

        self._registry = registry = Registry.open(Storage.from_environment(), create=False)
        address = ray.get_runtime_context().gcs_address
        self._supervisor = EvaluationSupervisor(registry, workers=workers, at_once=at_once, address=address)
        self._refresher = SnapshotRefresher(registry)
        self._supervisor.start()
        self._refresher.start()
        self._pool = GameWorkerPool()

    def __del__(self) -> None:
        for part in (self._pool, self._supervisor, self._refresher):
            part.close()

    async def notify(self) -> None:
        """Check for evaluations to start or stop now instead of at the next poll."""
        self._supervisor.notify()

    async def work(self) -> None:
        """Return when no evaluation is left, snapshots are current and nobody plays or watches games."""
        while self._pool.is_in_use or await asyncio.to_thread(self._registry.needs_evaluation_service):
            await asyncio.sleep(POLL)

    async def request_game(self, request: str, timeout: float) -> dict[str, Any]:
        """Process a GameRequest in JSON.

        Returns `{"media_type", "content"}`, or `{"code", "message"}` of an error; NotReady after `timeout` seconds.
        """
        from league.errors import LeagueError, to_document
        from league.service_requests import GameRequest

        try:
            return asdict(await self._pool.submit(GameRequest.model_validate_json(request), timeout))
        except LeagueError as error:
            return to_document(error)

    def check_health(self) -> None:
        """Raise RuntimeError if a background thread has died. Ray Serve then replaces the replica."""
        if not (self._supervisor.is_alive() and self._refresher.is_alive()):
            raise RuntimeError("the evaluation supervisor or the snapshot refresher has stopped")


def deployment(workers: int, at_once: int) -> Any:
    """The bound deployment. It runs `at_once` evaluations with `workers` processes each.

    It reserves no CPU, so that it never prevents a replica from starting. `deployments` in deploy.yaml can override its
    options under the name `EvaluationService`.
    """
    from ray import serve

    options = serve.deployment(
        name="EvaluationService",
        # One replica while calls are in progress, and half a minute longer.
        autoscaling_config={
            "min_replicas": 0,
            "max_replicas": 1,
            "metrics_interval_s": POLL,
            "look_back_period_s": 2 * POLL,
            "downscale_to_zero_delay_s": 30,
        },
        ray_actor_options={"num_cpus": 0},
        max_queued_requests=128,  # of a replica, while the service cannot start
        max_ongoing_requests=128,  # most of them wait for a game: see evaluation/service/game_worker_pool.py
        health_check_period_s=5,
        health_check_timeout_s=10,
        graceful_shutdown_wait_loop_s=0.1,
        graceful_shutdown_timeout_s=5,
        logging_config={"log_level": "WARNING", "enable_access_log": False},
    )
    return options(EvaluationService).bind(workers, at_once)
