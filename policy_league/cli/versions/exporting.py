"""`league export`: the files of a version for use in other programs."""

from pathlib import Path
from typing import Annotated

import typer

from league.refs import CheckpointRef
from policy_league.cli.options import open_registry
from policy_league.cli.output import say


def export(
    ref: Annotated[str, typer.Argument(metavar="REF", help="Version, such as connect_four@champion.")],
    directory: Annotated[
        Path | None, typer.Argument(metavar="DIR", help="Directory to write. Default: LEAGUE-NUMBER.")
    ] = None,
) -> None:
    """Write the ONNX files and the manifest of a version.

    The files are verified against their digests. docs/exporting.md shows how to run them in a browser, Unity, Godot and
    C++. `league import` reads the directory.
    """
    from league.policies.loading import require_one_policy
    from league.registry.storage.exports import export_version

    registry = open_registry()
    version = registry.versions.with_files(CheckpointRef.parse(ref))
    require_one_policy(version)
    target = directory or Path(f"{version.league}-{version.number}")
    for file in export_version(version, registry.artifacts, target):
        say(str(file))
