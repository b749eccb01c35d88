"""The pulse of a league: whoever has seen one, and sees another, knows what there is to look at again.

It is taken often: each query reads the end of an index, or the few rows that there are.
"""

from collections import Counter
from datetime import timedelta

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from league.registry import acknowledgements, aliases, evaluations, rows, runs
from league.registry.tables import READY, AliasEvent, Evaluation, Snapshot, TrafficEvent, Verdict, Version, VersionNote

OPEN = "open"


def take(session: Session, league: str, since: timedelta) -> rows.Pulse:
    """The pulse of a league. `since`: for how long a replica may have been silent. Raises UnknownLeague."""
    serving = Counter(said.version for said in acknowledgements.fresh(session, league, since) if said.version)
    outcomes = select(Verdict.outcome, func.count()).filter_by(league=league).group_by(Verdict.outcome)
    return rows.Pulse(
        league=league,
        aliases=aliases.current(session, league),
        event=session.scalar(select(func.max(AliasEvent.id)).filter_by(league=league)),
        version=session.scalar(select(func.max(Version.number)).filter_by(league=league, state=READY)),
        note=session.scalar(select(func.max(VersionNote.id)).filter_by(league=league)),
        traffic=session.scalar(select(func.max(TrafficEvent.id)).filter_by(league=league)),
        serving=dict(sorted(serving.items())),
        verdicts={outcome or OPEN: count for outcome, count in session.execute(outcomes)},
        evaluation=session.scalar(select(func.max(Evaluation.id)).filter_by(league=league)),
        evaluations=evaluations.active(session, league),
        run=next((row.id for row in runs.newest(session, league, before=None, limit=1)), None),
        runs=runs.active(session, league),
        computed_at=session.scalar(select(func.max(Snapshot.at)).filter_by(league=league)),
    )
