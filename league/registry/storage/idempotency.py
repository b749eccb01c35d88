"""Applies a state-changing call once, however often the client repeats it.

A client names a call with an idempotency key. The id of the resulting event or evaluation is stored in the transaction
of the change itself, so the call and its result are committed together or not at all. Events never change, so a
repeated call gets the same response; an evaluation is returned in its current state.
"""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Literal, Protocol, TypeVar

from sqlalchemy import delete
from sqlalchemy.orm import Session

from league.errors import KeyReused
from league.registry.storage.database import insert
from league.registry.storage.tables import IdempotentCallTable

KEPT = timedelta(hours=24)


@dataclass(frozen=True, slots=True)
class IdempotentCall:
    """The identity of a call: `owner` is the id of the API key, `digest` identifies the request."""

    owner: str
    key: str
    digest: str


class _Stored(Protocol):
    @property
    def id(self) -> int | None: ...


R = TypeVar("R", bound=_Stored)


def apply_once(
    session: Session,
    call: IdempotentCall | None,
    column: Literal["event", "traffic", "evaluation"],
    *,
    change: Callable[[], R],
    load: Callable[[int], R],
) -> R:
    """Run `change`, or `load` the result (its id is in `column`) of an earlier run for the same `call`.

    The session must hold the lock of the league, so that a repeated call waits for the first. A failed change stores
    nothing and may be retried. Raises what `change` raises, or KeyReused if the key was used for another request.
    """
    if call is None:
        return change()
    called_at = datetime.now(UTC)
    session.execute(delete(IdempotentCallTable).where(IdempotentCallTable.at < called_at - KEPT))
    earlier_call = session.get(IdempotentCallTable, (call.owner, call.key))
    if earlier_call is not None and earlier_call.digest == call.digest:
        # Equal digests are equal requests, so the stored result is of the kind that `change` returns.
        return load(getattr(earlier_call, column))
    if earlier_call is None:
        result = change()
        values = {"owner": call.owner, "key": call.key, "digest": call.digest, column: result.id, "at": called_at}
        if insert(session, IdempotentCallTable, [values]):
            return result
    raise KeyReused(f"the Idempotency-Key {call.key!r} was used for another call: use a new key for each change")
