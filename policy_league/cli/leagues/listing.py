"""`league list` and `league archive`."""

from typing import TYPE_CHECKING, Annotated, Any

import typer

from league.errors import Conflict
from league.refs import CHAMPION, check_slug, short_verdict
from policy_league.cli.options import AsJson, LeagueName, open_registry
from policy_league.cli.output import emit, say, table

if TYPE_CHECKING:
    from league.registry.registry import Registry


def list_(as_json: AsJson = False) -> None:
    """List all leagues with versions, champion, last verdict and night.

    `league archive` marks a league as archived; `league remove` deletes one.
    """
    documents = _documents(open_registry())
    if as_json:
        emit({"leagues": documents})
        return
    if not documents:
        say("No league is registered yet. Create a configuration: league init my_package.my_game:make_env")
        return
    table(
        ("league", "versions", "champion", "last verdict", "last night", "state"),
        [
            (
                document["league"],
                document["versions"],
                None if document["champion"] is None else f"@{document['champion']}",
                document["last_verdict"]
                and f"{short_verdict(document['last_verdict']['verdict'])} {document['last_verdict']['outcome']}",
                document["last_night"] and f"{document['last_night'].astimezone():%Y-%m-%d}",
                document["archived_at"] and "archived",
            )
            for document in documents
        ],
        optional=("state",),
    )


def _documents(registry: "Registry") -> list[dict[str, Any]]:
    aliases, versions = registry.aliases.all(), registry.versions.numbers()
    verdicts, nights = registry.verdicts.last_closed(), registry.nightly_runs.last_ended()
    documents = []
    for league, archived_at in registry.leagues.names().items():
        champion, verdict = aliases.get((league, CHAMPION)), verdicts.get(league)
        documents.append(
            {
                "league": league,
                "versions": len(versions.get(league, ())),
                "champion": champion and champion.version,
                "last_verdict": verdict
                and {
                    "verdict": verdict.id,
                    "candidate": f"{league}@{verdict.candidate}",
                    "outcome": verdict.outcome,
                    "closed_at": verdict.closed_at,
                },
                "last_night": nights.get(league),
                "archived_at": archived_at,
            }
        )
    return documents


def archive(
    league: LeagueName,
    undo: Annotated[bool, typer.Option("--undo", help="Make the league active again.")] = False,
    as_json: AsJson = False,
) -> None:
    """Archive a league, or make it active again.

    Nothing can be trained, imported or tested in an archived league, and `league nightly` skips it. Its versions are
    still served, and its results can be viewed.
    """
    registry = open_registry()
    active = [run.id for run in registry.runs.newest(check_slug("league", league)) if run.state == "running"]
    if active and not undo:
        raise Conflict(f"training run {active[0]} of league {league} is active: stop it first, or wait for its end")
    row = registry.leagues.archive(league, undo)
    if as_json:
        emit({"league": row.slug, "archived_at": row.archived_at})
    else:
        say(f"{row.slug} is {'active' if undo else 'archived'}.")
