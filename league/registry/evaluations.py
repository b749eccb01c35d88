"""Evaluations that are asked of the service: who may play one, how far it is, and how it ended.

    queued → running → done | failed | stopped

A runner, a process that plays, claims one and says again and again that it lives. One that falls silent, or that its
studio has seen die, loses its claim, and another goes on where the ledger is. Stopping is a request: it ends what is
queued at once, and what runs as soon as its runner has seen it.
"""

from datetime import UTC, datetime, timedelta
from typing import Any

from sqlalchemy import ColumnElement, func, or_, select
from sqlalchemy.orm import Session

from league.errors import TooManyEvaluations, UnknownEvaluation
from league.registry import leagues, rows
from league.registry.rows import EvaluationRow
from league.registry.tables import Evaluation

QUEUED, RUNNING, DONE, FAILED, STOPPED = "queued", "running", "done", "failed", "stopped"
SILENT = timedelta(seconds=15)
"""A runner that has said nothing for longer has died."""
ATTEMPTS = 5
"""Runners that may die one after another without getting on: then it is the evaluation that kills them."""
GIVEN_UP = {
    "code": "worker_lost",
    "message": f"{ATTEMPTS} processes that played this died, one after another, without getting on",
}


def ask(
    session: Session,
    league: str,
    asked: dict[str, Any],
    *,
    actor: str,
    key: str | None,
    reason: str | None,
    most: int,
) -> EvaluationRow:
    """Queue an evaluation. Raises UnknownLeague, or TooManyEvaluations where `most` are queued or running.

    Two that come at the same moment for different leagues may both be the last one.
    """
    leagues.lock(session, league)
    waiting = session.scalar(select(func.count()).where(Evaluation.state.in_((QUEUED, RUNNING)))) or 0
    if waiting >= most:
        raise TooManyEvaluations(
            f"{waiting} evaluations are queued or running, and {most} are the most: come back later"
        )
    evaluation = Evaluation(
        league=league,
        asked=asked,
        state=QUEUED,
        actor=actor,
        key=key,
        reason=reason,
        attempts=0,
        created_at=datetime.now(UTC),
    )
    session.add(evaluation)
    session.flush()
    return row(evaluation)


def one(session: Session, league: str, number: int) -> EvaluationRow:
    """One of a league. Raises UnknownLeague or UnknownEvaluation."""
    return row(_of_league(session, league, number))


def newest(session: Session, league: str, before: int | None, limit: int) -> list[EvaluationRow]:
    """Those of a league, newest first, at most `limit`, of those older than number `before`. Raises UnknownLeague."""
    leagues.require(session, league)
    query = select(Evaluation).filter_by(league=league).order_by(Evaluation.id.desc()).limit(limit)
    if before is not None:
        query = query.where(Evaluation.id < before)
    return [row(evaluation) for evaluation in session.scalars(query)]


def active(session: Session, league: str) -> tuple[EvaluationRow, ...]:
    """Those of a league that are queued or running, oldest first."""
    query = select(Evaluation).where(Evaluation.state.in_((QUEUED, RUNNING)), Evaluation.league == league)
    return tuple(row(evaluation) for evaluation in session.scalars(query.order_by(Evaluation.id)))


def counts(session: Session) -> dict[str, dict[str, int]]:
    """league → how many are queued and running, of the leagues that have any."""
    query = select(Evaluation.league, Evaluation.state, func.count()).where(Evaluation.state.in_((QUEUED, RUNNING)))
    found: dict[str, dict[str, int]] = {}
    for league, state, count in session.execute(query.group_by(Evaluation.league, Evaluation.state)):
        found.setdefault(league, {})[state] = count
    return found


def stop(session: Session, league: str, number: int, actor: str) -> EvaluationRow:
    """Ask for the end of one; what has ended stays as it is. Raises UnknownLeague or UnknownEvaluation."""
    evaluation = _of_league(session, league, number, lock=True)
    if evaluation.state in (QUEUED, RUNNING) and evaluation.stop_at is None:
        evaluation.stop_at, evaluation.stopped_by = datetime.now(UTC), actor
        if evaluation.state == QUEUED:
            _end(evaluation, STOPPED)
    return row(evaluation)


def wait(session: Session) -> bool:
    """Whether there is one to claim."""
    return session.scalar(select(Evaluation.id).where(_is_free()).limit(1)) is not None


def claim(session: Session, runner: str, workers: int) -> EvaluationRow | None:
    """Give the oldest that waits, or whose runner has died, to `runner`; None if there is none."""
    now = datetime.now(UTC)
    # One at a time: who locked all that are free would leave none to those who claim beside it.
    query = select(Evaluation).where(_is_free()).order_by(Evaluation.id).limit(1)
    while (evaluation := session.scalar(query.with_for_update(skip_locked=True))) is not None:
        if not _ends_here(evaluation):
            evaluation.state, evaluation.runner, evaluation.workers = RUNNING, runner, workers
            evaluation.attempts += 1
            evaluation.started_at = evaluation.started_at or now
            evaluation.heartbeat_at = now
            return row(evaluation)
    return None


def beat(session: Session, number: int, runner: str, progress: dict[str, Any] | None) -> EvaluationRow:
    """Say that `runner` lives and how far it is. What is returned tells whether it is still its runner's."""
    evaluation = session.get_one(Evaluation, number, with_for_update=True)
    if _is_held(evaluation, runner):
        evaluation.heartbeat_at = datetime.now(UTC)
        if progress is not None and progress != evaluation.progress:
            evaluation.progress, evaluation.attempts = progress, 0
    return row(evaluation)


def finish(
    session: Session,
    number: int,
    runner: str,
    state: rows.EvaluationState,
    *,
    progress: dict[str, Any] | None,
    result: dict[str, Any] | None,
    error: dict[str, str] | None,
) -> None:
    """Record how it ended, unless another runner has it by now."""
    evaluation = session.get_one(Evaluation, number, with_for_update=True)
    if _is_held(evaluation, runner):
        evaluation.progress, evaluation.result = progress or evaluation.progress, result
        _end(evaluation, state, error)


def release(session: Session, number: int, runner: str) -> None:
    """`runner` is gone: what it has not brought to an end waits for another, unless it was to be stopped."""
    evaluation = session.get_one(Evaluation, number, with_for_update=True)
    if _is_held(evaluation, runner) and not _ends_here(evaluation):
        evaluation.state = QUEUED


def row(evaluation: Evaluation) -> EvaluationRow:
    """An evaluation as the registry answers it."""
    return EvaluationRow(**{name: getattr(evaluation, name) for name in EvaluationRow.__slots__})


def _of_league(session: Session, league: str, number: int, lock: bool = False) -> Evaluation:
    leagues.require(session, league)
    evaluation = session.get(Evaluation, number, with_for_update=lock or None)
    if evaluation is None or evaluation.league != league:
        raise UnknownEvaluation(f"league {league} has no evaluation {number}")
    return evaluation


def _is_free() -> ColumnElement[bool]:
    is_left = (Evaluation.state == RUNNING) & (Evaluation.heartbeat_at < datetime.now(UTC) - SILENT)
    return or_(Evaluation.state == QUEUED, is_left)


def _is_held(evaluation: Evaluation, runner: str) -> bool:
    return evaluation.state == RUNNING and evaluation.runner == runner


def _ends_here(evaluation: Evaluation) -> bool:
    """End one that no runner holds, if it is to go no further."""
    if evaluation.stop_at is not None:
        _end(evaluation, STOPPED)
    elif evaluation.attempts >= ATTEMPTS:
        _end(evaluation, FAILED, GIVEN_UP)
    else:
        return False
    return True


def _end(evaluation: Evaluation, state: str, error: dict[str, str] | None = None) -> None:
    evaluation.state, evaluation.error, evaluation.ended_at = state, error, datetime.now(UTC)
