"""The open gateways: where the simulators of a league find a process that needs episodes."""

from dataclasses import dataclass
from datetime import timedelta
from typing import Literal, cast

from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from league.registry import leagues
from league.registry.storage.database import Repository, clock, reading, sql_clock, upsert, writing
from league.registry.storage.tables import GatewayTable
from league.settings import Storage

Purpose = Literal["training", "evaluation"]
SILENCE = timedelta(seconds=15)
"""A gateway that was not announced for this time has ended with its process."""


@dataclass(frozen=True, slots=True)
class ForSimulators:
    """For what episodes are needed that simulators may play. storage: where they find the gateway."""

    storage: Storage
    league: str
    purpose: Purpose = "evaluation"


@dataclass(frozen=True, slots=True)
class Gateway:
    """A gateway.

    Attributes:
        url: The address of its WebSocket server.
        token: The key that it expects.
        league: Its league.
        purpose: What its episodes are for.
        simulators: Number of simulators that are connected.
        waiting: Number of episodes that wait for one.
    """

    url: str
    token: str
    league: str
    purpose: Purpose
    simulators: int = 0
    waiting: int = 0

    @property
    def is_evaluation(self) -> bool:
        """Whether its episodes are matches of an evaluation."""
        return self.purpose == "evaluation"


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
        upsert(session, GatewayTable, key, values | {"seen_at": sql_clock(session)})
        session.execute(delete(GatewayTable).where(GatewayTable.seen_at < clock(session) - 4 * SILENCE))

    @reading
    def open(self, session: Session, league: str) -> list[Gateway]:
        """Return the open gateways of a league: those without simulators first, and of these those of evaluations."""
        table = GatewayTable
        query = select(table).filter_by(league=league).where(table.seen_at >= clock(session) - SILENCE)
        rows = session.scalars(query.order_by(table.simulators, table.purpose, table.url)).all()
        return [
            Gateway(row.url, row.token, row.league, cast(Purpose, row.purpose), row.simulators, row.waiting)
            for row in rows
        ]

    @writing
    def close(self, session: Session, gateway: Gateway) -> None:
        """Record that a gateway is closed."""
        session.execute(delete(GatewayTable).filter_by(url=gateway.url, token=gateway.token))
