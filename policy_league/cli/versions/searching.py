"""`league search`: publishes a version that looks ahead."""

from typing import Annotated, Literal

import typer

from league.refs import CheckpointRef
from policy_league.cli.options import Actor, AsJson, acting, open_registry
from policy_league.cli.output import emit, say


def search(
    ref: Annotated[
        str, typer.Argument(metavar="REF", help="Version that evaluates positions, such as connect_four@champion.")
    ],
    simulations: Annotated[
        int, typer.Option(min=1, max=10_000, help="Positions that each decision evaluates besides the current one.")
    ] = 100,
    rule: Annotated[
        Literal["puct", "gumbel"], typer.Option(help="`puct`: as in AlphaZero; `gumbel`: sequential halving.")
    ] = "puct",
    note: Annotated[str | None, typer.Option(metavar="TEXT", help="Note of the new version.")] = None,
    actor: Actor = None,
    as_json: AsJson = False,
) -> None:
    """Publish a version that plays another one with a search.

    It is rated, tested, promoted and served like any version. The environment must be vectorised, and a game of two
    agents with perfect information and without chance. Repeated with the same options, it prints the version that
    exists.
    """
    from league.environments.building import interface
    from league.search.policies import publish_search

    registry = open_registry()
    base = registry.versions.with_files(CheckpointRef.parse(ref))
    league = registry.leagues.follow_code(base.league, interface)
    version = publish_search(registry, base, league.config.environment, league.interface, rule, simulations)
    if note is not None:
        version = registry.versions.set_note(CheckpointRef(version.league, version.number), note, actor=acting(actor))
    if as_json:
        emit(
            {
                "league": version.league,
                "version": version.number,
                "search": version.search and version.search.model_dump(),
            }
        )
        return
    say(f"{version.ref} plays {base.ref} with a search of {simulations} simulations ({rule})")
