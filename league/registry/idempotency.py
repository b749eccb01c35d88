"""Calls that change state are applied once, however often they arrive.

A caller names its call by a key of its own. What the call led to, an event of an alias or of traffic or an evaluation,
is kept with it, in the transaction of the change itself: the call and its answer are there together, or neither is.
Events never change, so that the same answer can be given again; an evaluation is answered as far as it is by then.
"""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import TypeVar, cast

from sqlalchemy import delete
from sqlalchemy.orm import Session

from league.errors import KeyReused
from league.registry import aliases, evaluations, leagues, rows, traffic
from league.registry.database import insert
from league.registry.tables import AliasEvent, Evaluation, IdempotentCall, TrafficEvent

KEPT = timedelta(hours=24)


@dataclass(frozen=True, slots=True)
class Call:
    """A call as its caller names it: `owner` is the API key's id, `digest` tells what was asked."""

    owner: str
    key: str
    digest: str


E = TypeVar("E", rows.AliasEvent, rows.Traffic, rows.EvaluationRow)
COLUMNS = {rows.AliasEvent: "event", rows.Traffic: "traffic", rows.EvaluationRow: "evaluation"}


def once(session: Session, league: str, call: Call | None, change: Callable[[], E]) -> E:
    """Do `change` to a league, unless `call` has done so: then return the event or evaluation that it led to.

    A change that fails leaves nothing, and may be tried again. Raises UnknownLeague, what `change` raises, or KeyReused
    if the call of that name asked for something else.
    """
    if call is None:
        return change()
    leagues.lock(session, league)  # a repetition waits here for the first
    now = datetime.now(UTC)
    session.execute(delete(IdempotentCall).where(IdempotentCall.at < now - KEPT))
    known = session.get(IdempotentCall, (call.owner, call.key))
    if known is not None and known.digest == call.digest:
        # The digest tells what was asked, so the event is of the kind that `change` makes.
        return cast(E, _event(session, known))
    if known is None:
        event = change()
        values = {
            "owner": call.owner,
            "key": call.key,
            "digest": call.digest,
            COLUMNS[type(event)]: event.id,
            "at": now,
        }
        if insert(session, IdempotentCall, [values]):
            return event
    raise KeyReused(f"the Idempotency-Key {call.key!r} was used for another call: take a new one for each change")


def _event(session: Session, call: IdempotentCall) -> rows.AliasEvent | rows.Traffic | rows.EvaluationRow:
    if call.evaluation is not None:
        return evaluations.row(session.get_one(Evaluation, call.evaluation))
    if call.traffic is not None:
        return traffic.row(session.get_one(TrafficEvent, call.traffic))
    return aliases.row(session.get_one(AliasEvent, call.event))
