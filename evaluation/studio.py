"""The studio: a Serve deployment for what needs an environment. The service calls it by handle; it plays evaluations,
and games for people, and keeps what pages show of leagues up to date.

deploy.yaml names it by import string, and the service's replicas never load it. It holds nothing that is missed: what
evaluations were asked, and how far they are, is in the registry, and a person's game is in what that person sends. So
it may die and be started again at any time. It imports no environment itself: those are in processes of its own.
"""

from dataclasses import asdict
from typing import Any


class Studio:
    """One replica. Where its leagues live, LEAGUE_HOME and its siblings say."""

    def __init__(self, workers: int, at_once: int) -> None:
        import ray

        from evaluation.keeper import Keeper
        from evaluation.runners import Runners
        from evaluation.stages import Stages
        from league.registry.registry import Registry
        from league.settings import Storage

        registry = Registry.open(Storage.from_environment(), create=False)
        address = ray.get_runtime_context().gcs_address
        self._runners = Runners(registry, workers=workers, at_once=at_once, address=address)
        self._keeper = Keeper(registry)
        self._runners.start()
        self._keeper.start()
        self._stages = Stages()

    def __del__(self) -> None:
        self._stages.close()
        self._runners.close()
        self._keeper.close()

    async def look(self) -> None:
        """There is an evaluation to play, or to stop. It would be found a moment later anyway."""
        self._runners.look()

    async def ask(self, order: str, patience: float) -> dict[str, Any]:
        """Show a game or play one, as an Order in JSON says: {"media_type", "content"}, or {"code", "message"}.

        patience: seconds after which the answer is that it takes longer.
        """
        from league.errors import LeagueError
        from league.games import Order

        try:
            return asdict(await self._stages.ask(Order.model_validate_json(order), patience))
        except LeagueError as error:
            return {"code": error.code, "message": str(error)}

    def check_health(self) -> None:
        """Ray Serve replaces a studio that no longer looks after evaluations or snapshots."""
        if not (self._runners.are_watched and self._keeper.is_watching):
            raise RuntimeError("nobody looks after evaluations, or after snapshots")


def deployment(workers: int, at_once: int) -> Any:
    """The studio, bound: `workers` processes play each evaluation, `at_once` of them.

    It reserves no CPU, so that it never keeps a replica from starting. `deployments` of deploy.yaml may say otherwise,
    by its name, `Studio`.
    """
    from ray import serve

    options = serve.deployment(
        name="Studio",
        num_replicas=1,
        ray_actor_options={"num_cpus": 0},
        max_ongoing_requests=128,  # most of them wait for a game: see evaluation/stages.py
        health_check_period_s=5,
        health_check_timeout_s=10,
        graceful_shutdown_wait_loop_s=0.1,
        graceful_shutdown_timeout_s=5,
        logging_config={"log_level": "WARNING", "enable_access_log": False},
    )
    return options(Studio).bind(workers, at_once)
