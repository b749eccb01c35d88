"""`league runs`."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from league.refs import CheckpointRef, check_slug
from policy_league.cli.options import AsJson, LeagueName, open_registry
from policy_league.cli.output import emit, say, table

if TYPE_CHECKING:
    from league.registry.storage.rows import RunRow, StrengthRow


def runs(
    league: LeagueName,
    limit: Annotated[int, typer.Option(min=1, max=1000, help="Maximum number of runs.")] = 20,
    as_json: AsJson = False,
) -> None:
    """List a league's training runs, newest first.

    Shows the role of their versions, their progress, and the last measured scores against the champion and an anchor
    with 95 % intervals (`training.strength`).
    """
    registry = open_registry()
    rows = registry.runs.newest(check_slug("league", league), limit=limit)
    strength = {}
    for row in rows:
        scores = registry.strength.of_run(league, row.id)
        strength[row.id] = [score for score in scores if score.version == scores[-1].version]  # the newest one's
    if as_json:
        emit({"league": league, "runs": [_run_document(row, strength[row.id]) for row in rows]})
        return
    if not rows:
        say(f"{league} has no training runs yet. Start one: league train CONFIG")
        return
    table(
        ("run", "state", "role", "steps", "minutes", "strength"),
        [
            (
                row.id,
                row.state,
                row.role if row.exploits is None else f"{row.role} of @{CheckpointRef.parse(row.exploits).version}",
                row.steps,
                f"{row.seconds / 60:.1f}",
                "; ".join(_score(measurement, league) for measurement in strength[row.id]),
            )
            for row in rows
        ],
        prose=("strength",),
        optional=("strength",),
    )


def _score(row: "StrengthRow", league: str) -> str:
    opponent = row.opponent.removeprefix(league)
    return f"@{row.version}: {row.score:.0%} [{row.low:.0%}, {row.high:.0%}] against {opponent}"


def _run_document(row: "RunRow", strength: "Sequence[StrengthRow]") -> dict[str, object]:
    names = "state", "role", "exploits", "algorithm", "seed", "steps", "target", "seconds", "parent", "error"
    times = "began_at", "heartbeat_at", "ended_at"
    fields = "version", "steps", "opponent", "games", "score", "low", "high", "at"
    scores = [{name: getattr(measurement, name) for name in fields} for measurement in strength]
    return {"run": row.id} | {name: getattr(row, name) for name in (*names, *times)} | {"strength": scores}
