"""The open gateways: where the simulators of a league find a process that needs episodes."""

from dataclasses import dataclass
from datetime import timedelta

from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from league.registry import leagues
from league.registry.storage.database import Repository, clock, reading, sql_clock, upsert, writing
from league.registry.storage.rows import Gateway, Purpose
from league.settings import Storage

SILENCE = timedelta(seconds=15)
"""A gateway that was not announced for this time has ended with its process."""


@dataclass(frozen=True, slots=True)
class ForSimulators:
    """For what episodes are needed that simulators may play. storage: where they find the gateway."""

    storage: Storage
    league: str
    purpose: Purpose = "evaluation"


class GatewayRepository(Repository):
    """Announces gateways, and finds them."""

    @writing
    def announce(self, session: Session, gateway: Gateway) -> None:
        """Record that a gateway is open now. Its process repeats that more often than SILENCE.

        Raises UnknownLeague.
        """
        leagues.require(session, gateway.league)
        values = {name: getattr(gateway, name) for name in ("league", "purpose", "simulators", "waiting")}
        key = {"url": gateway.url, "token": gateway.token}
        upsert(session, Gateway, key, values | {"seen_at": sql_clock(session)})
        session.execute(delete(Gateway).where(Gateway.seen_at < clock(session) - 4 * SILENCE))

    @reading
    def open(self, session: Session, league: str) -> list[Gateway]:
        """Return the open gateways of a league: those without simulators first, and of these those of evaluations."""
        query = select(Gateway).filter_by(league=league).where(Gateway.seen_at >= clock(session) - SILENCE)
        return list(session.scalars(query.order_by(Gateway.simulators, Gateway.purpose, Gateway.url)))

    @writing
    def close(self, session: Session, gateway: Gateway) -> None:
        """Record that a gateway is closed."""
        session.execute(delete(Gateway).filter_by(url=gateway.url, token=gateway.token))
