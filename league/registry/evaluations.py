"""The queue of evaluations that clients request.

    queued → running → done | failed | stopped

A runner (a process that plays evaluations) claims an evaluation and sends heartbeats. If they stop, or the service sees
the runner die, the claim is released and another runner resumes from the ledger. Stopping is a request: a queued
evaluation ends immediately, a running one as soon as its runner notices.
"""

from datetime import UTC, datetime, timedelta
from functools import partial
from typing import Any

from sqlalchemy import ColumnElement, func, or_, select
from sqlalchemy.orm import Session

from league.errors import TooManyEvaluations, UnknownEvaluation
from league.registry import leagues
from league.registry.storage.database import Repository, reading, writing
from league.registry.storage.idempotency import IdempotentCall, apply_once
from league.registry.storage.rows import EvaluationRow, EvaluationState

QUEUED: EvaluationState = "queued"
RUNNING: EvaluationState = "running"
FAILED: EvaluationState = "failed"
STOPPED: EvaluationState = "stopped"
HEARTBEAT_TIMEOUT = timedelta(seconds=15)
"""A runner without a heartbeat for longer is considered dead."""
MAX_ATTEMPTS = 5
"""Consecutive runners that may die without progress before the evaluation fails."""
GIVEN_UP = {
    "code": "worker_lost",
    "message": f"{MAX_ATTEMPTS} worker processes died one after another without making progress",
}


class EvaluationRepository(Repository):
    """Queues, claims, updates and reads evaluations."""

    @writing
    def submit(
        self,
        session: Session,
        league: str,
        request: dict[str, Any],
        *,
        actor: str,
        key: str | None = None,
        reason: str | None = None,
        max_active: int,
        max_of_league: int | None = None,
        call: IdempotentCall | None = None,
    ) -> EvaluationRow:
        """Queue an evaluation. A repeated `call` queues nothing and returns its evaluation in its current state.

        key: the id of the client's API key. max_active: the limit of queued and running evaluations in all leagues;
        two concurrent submissions for different leagues may exceed it by one. max_of_league: the limit of this league.
        Raises UnknownLeague, TooManyEvaluations or KeyReused.
        """
        leagues.lock(session, league)

        def change() -> EvaluationRow:
            active = select(func.count()).where(EvaluationRow.state.in_((QUEUED, RUNNING)))
            for query, limit, where in (
                (active, max_active, ""),
                (
                    active.where(EvaluationRow.league == league),
                    max_active if max_of_league is None else max_of_league,
                    f" of {league}",
                ),
            ):
                if (waiting := session.scalar(query) or 0) >= limit:
                    raise TooManyEvaluations(
                        f"{waiting} evaluations{where} are queued or running, the limit is {limit}: try again later"
                    )
            evaluation = EvaluationRow(
                league=league,
                request=request,
                state=QUEUED,
                actor=actor,
                key=key,
                reason=reason,
                created_at=datetime.now(UTC),
            )
            session.add(evaluation)
            session.flush()
            return evaluation

        return apply_once(session, call, "evaluation", change=change, load=partial(session.get_one, EvaluationRow))

    @reading
    def get(self, session: Session, league: str, number: int) -> EvaluationRow:
        """Return one evaluation. Raises UnknownLeague or UnknownEvaluation."""
        return _of_league(session, league, number)

    @reading
    def newest(
        self, session: Session, league: str, *, before: int | None = None, limit: int = 20
    ) -> list[EvaluationRow]:
        """Return at most `limit` evaluations of a league, newest first. Raises UnknownLeague.

        before: return only evaluations with a lower number.
        """
        query = select(EvaluationRow).filter_by(league=league).order_by(EvaluationRow.id.desc()).limit(limit)
        if before is not None:
            query = query.where(EvaluationRow.id < before)
        return leagues.rows(session, league, query)

    @reading
    def counts(self, session: Session) -> dict[str, dict[str, int]]:
        """Return league → state → number of queued and running evaluations, of the leagues that have any."""
        table = EvaluationRow
        query = select(table.league, table.state, func.count()).where(table.state.in_((QUEUED, RUNNING)))
        counts: dict[str, dict[str, int]] = {}
        for league, state, count in session.execute(query.group_by(table.league, table.state)):
            counts.setdefault(league, {})[state] = count
        return counts

    @writing
    def stop(self, session: Session, league: str, number: int, *, actor: str) -> EvaluationRow:
        """Request the end of an evaluation; an ended one is unchanged. Raises UnknownLeague or UnknownEvaluation."""
        evaluation = _of_league(session, league, number, lock=True)
        if evaluation.state in (QUEUED, RUNNING) and evaluation.stop_at is None:
            evaluation.stop_at, evaluation.stopped_by = datetime.now(UTC), actor
            if evaluation.state == QUEUED:
                _end(evaluation, STOPPED)
        return evaluation

    def claim(self, runner: str, workers: int) -> EvaluationRow | None:
        """Assign the oldest evaluation that is queued, or whose runner is dead, to `runner`; None if there is none."""
        with self._database.read() as session:
            if session.scalar(select(EvaluationRow.id).where(_is_free()).limit(1)) is None:
                return None
        # One row at a time: locking all free rows would leave none for concurrent claims.
        query = select(EvaluationRow).where(_is_free()).order_by(EvaluationRow.id).limit(1)
        with self._database.write() as session:
            while (evaluation := session.scalar(query.with_for_update(skip_locked=True))) is not None:
                if not _ends_here(evaluation):
                    evaluation.state, evaluation.runner, evaluation.workers = RUNNING, runner, workers
                    evaluation.attempts += 1
                    evaluation.heartbeat_at = datetime.now(UTC)
                    evaluation.started_at = evaluation.started_at or evaluation.heartbeat_at
                    return evaluation
        return None

    @writing
    def heartbeat(
        self, session: Session, number: int, runner: str, progress: dict[str, Any] | None = None
    ) -> EvaluationRow:
        """Record a heartbeat of a runner and its progress.

        Returns the evaluation, which shows whether it is still assigned to `runner`.
        """
        evaluation = session.get_one(EvaluationRow, number, with_for_update=True)
        if _is_held(evaluation, runner):
            evaluation.heartbeat_at = datetime.now(UTC)
            if progress is not None and progress != evaluation.progress:
                evaluation.progress, evaluation.attempts = progress, 0
        return evaluation

    @writing
    def finish(
        self,
        session: Session,
        number: int,
        runner: str,
        state: EvaluationState,
        *,
        progress: dict[str, Any] | None = None,
        result: dict[str, Any] | None = None,
        error: dict[str, str] | None = None,
    ) -> None:
        """Record how an evaluation ended, unless another runner has claimed it."""
        evaluation = session.get_one(EvaluationRow, number, with_for_update=True)
        if _is_held(evaluation, runner):
            evaluation.progress, evaluation.result = progress or evaluation.progress, result
            _end(evaluation, state, error)

    @writing
    def release(self, session: Session, number: int, runner: str) -> None:
        """Queue an unfinished evaluation again because its runner is gone, unless it was to be stopped."""
        evaluation = session.get_one(EvaluationRow, number, with_for_update=True)
        if _is_held(evaluation, runner) and not _ends_here(evaluation):
            evaluation.state = QUEUED


def active(session: Session, league: str) -> tuple[EvaluationRow, ...]:
    """Return the queued and running evaluations of a league, oldest first."""
    table = EvaluationRow
    query = select(table).where(table.state.in_((QUEUED, RUNNING)), table.league == league).order_by(table.id)
    return tuple(session.scalars(query))


def _of_league(session: Session, league: str, number: int, lock: bool = False) -> EvaluationRow:
    leagues.require(session, league)
    evaluation = session.get(EvaluationRow, number, with_for_update=lock or None)
    if evaluation is None or evaluation.league != league:
        raise UnknownEvaluation(f"league {league} has no evaluation {number}")
    return evaluation


def _is_free() -> ColumnElement[bool]:
    oldest = datetime.now(UTC) - HEARTBEAT_TIMEOUT
    is_orphaned = (EvaluationRow.state == RUNNING) & (EvaluationRow.heartbeat_at < oldest)
    return or_(EvaluationRow.state == QUEUED, is_orphaned)


def _is_held(evaluation: EvaluationRow, runner: str) -> bool:
    return evaluation.state == RUNNING and evaluation.runner == runner


def _ends_here(evaluation: EvaluationRow) -> bool:
    """End an evaluation without a runner that was stopped or has used all attempts; returns whether it ended."""
    if evaluation.stop_at is not None:
        _end(evaluation, STOPPED)
    elif evaluation.attempts >= MAX_ATTEMPTS:
        _end(evaluation, FAILED, GIVEN_UP)
    else:
        return False
    return True


def _end(evaluation: EvaluationRow, state: EvaluationState, error: dict[str, str] | None = None) -> None:
    evaluation.state, evaluation.error, evaluation.ended_at = state, error, datetime.now(UTC)
