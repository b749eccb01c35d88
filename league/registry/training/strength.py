"""Strength during training: the scores of a run's versions against the champion and an anchor.

The games are not in the ledger: their results are no evidence, because a run plays them with the same seeds again and
again. They are kept here to show the progress of the run.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

from sqlalchemy import select
from sqlalchemy.orm import Session

from league.registry import leagues
from league.registry.storage.database import Repository, insert, reading, writing
from league.registry.storage.rows import StrengthRow


@dataclass(frozen=True, slots=True)
class StrengthScore:
    """The mean score in [0, 1] of `games` games against an opponent, with the bounds of its 95 % interval."""

    opponent: str
    games: int
    score: float
    low: float
    high: float


class StrengthRepository(Repository):
    """Records and reads the strength of versions."""

    @writing
    def record(self, session: Session, rows: Sequence[StrengthRow]) -> None:
        """Record scores of versions that a run has published. Scores that are recorded already are kept.

        Raises UnknownLeague.
        """
        for league in {row.league for row in rows}:
            leagues.require(session, league)
        insert(session, StrengthRow, [asdict(row) for row in rows])

    @reading
    def of_run(self, session: Session, league: str, run: str) -> list[StrengthRow]:
        """Return the scores of a run's versions, oldest version first. Raises UnknownLeague."""
        table = StrengthRow
        query = select(table).filter_by(league=league, run=run).order_by(table.version, table.at, table.opponent)
        return leagues.rows(session, league, query)
