"""`league train`"""

from pathlib import Path
from typing import Annotated

import typer

from cli.output import console, say
from league.config import LeagueConfig


def train(
    config: Annotated[Path, typer.Argument(help="The league's file, such as configs/connect_four.yaml.")],
    parent: Annotated[
        str | None,
        typer.Option("--from", metavar="REF", help="Train on from this version, e.g. connect_four@3 or @champion."),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the run that was interrupted.")] = False,
    address: Annotated[
        str | None, typer.Option(help="A running Ray cluster (`auto`, or host:port). Default: a local Ray.")
    ] = None,
    minutes: Annotated[float | None, typer.Option(help="Stop after this long, instead of what CONFIG says.")] = None,
    steps: Annotated[
        int | None, typer.Option(help="Stop after this many actions, instead of what CONFIG says.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Another seed than CONFIG's.")] = None,
) -> None:
    """Train a league's policies and publish a version at each checkpoint.

    Each version holds one ONNX graph per policy, proven to act as the trained network does. Curves are written for
    TensorBoard below LEAGUE_HOME/runs. Killed in the middle? `league train CONFIG --resume` goes on.

    Next: `league nightly CONFIG` finds out which version is the strongest, and promotes it.
    """
    league = LeagueConfig.load(config)
    settings = {"minutes": minutes, "steps": steps, "seed": seed}
    league = league.with_training(**{key: value for key, value in settings.items() if value is not None})
    from league.refs import CheckpointRef
    from league.registry.registry import Registry
    from training.run import train as run

    published = run(
        league,
        registry=Registry.open(),
        parent=None if parent is None else CheckpointRef.parse(_of_league(parent, league.league)),
        resume=resume,
        address=address,
        config_path=config,
        console=console,
    )
    if not published:
        say("Nothing was published: the run ended before its first checkpoint.")
        return
    say(f"\nPublished {', '.join(version.ref for version in published)}.")
    say(f"Next: league nightly {config}   (who is the strongest?)")


def _of_league(ref: str, league: str) -> str:
    """`@3` is short for a version of the league that is trained."""
    return league + ref if ref.startswith("@") else ref
