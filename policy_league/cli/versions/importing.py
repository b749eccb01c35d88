"""`league import`: publishes a model that was trained elsewhere as a version."""

from pathlib import Path
from typing import Annotated

import typer

from league.errors import InvalidInput
from league.refs import CheckpointRef, check_slug
from policy_league.cli.options import LeagueName, open_registry
from policy_league.cli.output import say


def import_model(
    league: LeagueName,
    source: Annotated[
        Path,
        typer.Argument(
            metavar="SOURCE",
            help="ONNX file or torch.export program (.pt2) for all policies, or a directory with a file for each.",
        ),
    ],
    mapping: Annotated[
        Path | None, typer.Option(metavar="FILE", help="YAML file with the names and meaning of inputs and outputs.")
    ] = None,
    rllib: Annotated[bool, typer.Option("--rllib", help="SOURCE is a checkpoint directory of RLlib.")] = False,
    sb3: Annotated[bool, typer.Option("--sb3", help="SOURCE is a file of Stable-Baselines3.")] = False,
    policy: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=MODULE", help="With --rllib: the module of a policy. Default: the same name."),
    ] = None,
    vec_normalize: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="With --sb3: statistics of VecNormalize, which become a part of the model."),
    ] = None,
    trust: Annotated[
        bool,
        typer.Option("--trust", help="Allow code in SOURCE to run. Every format except ONNX requires it."),
    ] = False,
    note: Annotated[str, typer.Option(metavar="TEXT", help="Note of the version.")] = "",
) -> None:
    """Publish a model that was trained elsewhere as a version.

    The model must reproduce its source's greedy actions on 10,000 observations from play, all of them legal and finite.
    The version is then evaluated, promoted and served like any other. docs/importing.md describes mapping files.
    """
    from training.importing.open_source import SourceKind, open_sources
    from training.importing.publish import publish

    registry = open_registry()
    interface = registry.leagues.get(check_slug("league", league)).interface
    modules = dict(_pair(text) for text in policy or ())
    kind: SourceKind | None = "rllib" if rllib else "sb3" if sb3 else None
    sources, digest = open_sources(
        source, interface, kind=kind, mapping=mapping, modules=modules, vec_normalize=vec_normalize, trust=trust
    )
    if sb3:
        wrappers = "wrappers of the training script" + (" except VecNormalize" if vec_normalize else "")
        say(f"{source.name} is without {wrappers}: league {league} must give the observations that its policy saw.")
    version = publish(league, sources, digest=digest, registry=registry)
    if note:
        registry.versions.set_note(CheckpointRef.parse(version.ref), note, actor="import")
    for name, entry in version.manifest.policies.items():
        parity = entry.parity
        say(
            f"policy {name}: {parity.mismatches} of {parity.observations} greedy actions differ from the source,"
            f" {parity.near_ties} in near ties"
        )
    say(f"{version.ref} is published. Evaluate it: league evaluate {league}")


def _pair(text: str) -> tuple[str, str]:
    name, equals, module = text.partition("=")
    if not (name and equals and module):
        raise InvalidInput(f"--policy {text!r}: expected NAME=MODULE")
    return name, module
