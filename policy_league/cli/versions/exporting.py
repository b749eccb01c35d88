"""`league export` and `league export-games`: the files of a version, and recorded games, for other programs."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from league.errors import InvalidInput
from league.refs import CheckpointRef
from policy_league.cli.options import LeagueName, open_registry
from policy_league.cli.output import counted, progress, say


def export(
    ref: Annotated[str, typer.Argument(metavar="REF", help="Version, such as connect_four@champion.")],
    target: Annotated[
        str | None,
        typer.Argument(
            metavar="TARGET",
            help="Directory to write. Default: LEAGUE-NUMBER. With --mlflow, the URI of MLflow's tracking server or"
            " store. Default: MLFLOW_TRACKING_URI.",
        ),
    ] = None,
    hub: Annotated[bool, typer.Option("--hub", help="Write a new folder for the Hugging Face Hub.")] = False,
    mlflow: Annotated[bool, typer.Option("--mlflow", help="Register models in MLflow.")] = False,
) -> None:
    """Write the ONNX files and the manifest of a version.

    The files are verified against their digests. docs/exporting.md shows how to run them in a browser, Unity, Godot and
    C++. `league import` reads the directory. With --hub or --mlflow, a model card describes interface and results.
    """
    from league.registry.storage.exports import CARD, exported_files, write_files, write_folder

    if hub and mlflow:
        raise InvalidInput("--hub and --mlflow have different targets: export twice")
    registry = open_registry()
    version = registry.versions.with_files(CheckpointRef.parse(ref))
    version.require_policies()
    files = exported_files(version, registry.artifacts)
    directory = Path(target or f"{version.league}-{version.number}")
    if not (hub or mlflow):
        written: Sequence[object] = write_files(files, directory)
    else:
        from evaluation.reporting.model_card import model_card

        card = model_card(registry, version)
        if hub:
            written = write_folder({CARD: card.encode()} | files, directory)
        else:
            from training.export.mlflow_models import register_models

            written = register_models(version, files, card, target)
    for name in written:
        say(str(name))


def export_games(
    league: LeagueName,
    directory: Annotated[Path, typer.Argument(metavar="DIRECTORY", help="New directory for the files.")],
    players: Annotated[
        list[str] | None,
        typer.Option("--player", metavar="REF", help="Only decisions of this contestant. Can be repeated."),
    ] = None,
    games: Annotated[int | None, typer.Option(min=1, help="Number of games. Default: all.")] = None,
) -> None:
    """Write the recorded games of a league as Parquet, to learn from.

    Games that count under the current rules are played again from the ledger. There is a file for each policy, with a
    row for each decision: observation, action mask, action, reward, and who decided.
    """
    from evaluation.playback.dataset import write_games

    registry = open_registry()
    with progress(f"replaying games of {league}") as show:
        rows = write_games(registry, league, directory, players or (), games, lambda done: show(counted(done, "game")))
    for policy, number in rows.items():
        say(f"{directory / policy}.parquet: {counted(number, 'decision')}")
