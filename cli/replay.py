"""`league replay`: a game as a film, or in a window."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cli.output import console, say
from league.errors import InvalidReference
from league.registry.registry import Registry

if TYPE_CHECKING:
    from evaluation.captions import Caption
    from evaluation.film import Film
    from evaluation.shows import Show


def replay(
    refs: Annotated[
        list[str] | None,
        typer.Argument(metavar="[REF]…", help="Who plays, e.g. connect_four@3 script:random. One alone plays itself."),
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="The film: a name that ends in .gif or .webp.")] = Path(
        "replay.gif"
    ),
    seed: Annotated[int, typer.Option(min=0, help="Of the environment, and of what scripts draw.")] = 0,
    side: Annotated[
        str | None, typer.Option(help="What the first REF plays; the others follow in order. Default: the first side.")
    ] = None,
    fps: Annotated[
        float | None,
        typer.Option(min=0.1, max=50, help="Steps per second. Default: 2 where agents take turns, else 10."),
    ] = None,
    max_frames: Annotated[int, typer.Option(min=1, help="The film ends here if the game does not.")] = 500,
    in_window: Annotated[bool, typer.Option("--watch", help="Show it in a window instead of writing a film.")] = False,
    match: Annotated[
        str | None, typer.Option(metavar="ID", help="A recorded match of the ledger, exactly as it was played.")
    ] = None,
    game: Annotated[int, typer.Option(min=0, help="Which game of that match.")] = 0,
) -> None:
    """Show a game between versions or scripts, or a recorded one, with what was played and how likely it was.

    Versions play their best action. One REF plays all sides, of several the last one plays all sides that are left.
    """
    from evaluation.film import film, watch

    registry = Registry.open()
    show = _show(registry, refs or [], match, game, side, seed)
    if in_window:
        done = watch(show, fps, listener=_tell)
        say(_ending(show, done))
        return
    with console.status("") as status:
        done = film(show, out, fps, max_frames, listener=lambda caption: status.update(f"filming {caption.step}"))
    say(f"{out}: {_ending(show, done)}")
    if not done.is_whole:
        say(f"The film ends before the game does: --max-frames is {max_frames}.")


def _show(registry: Registry, refs: list[str], match: str | None, game: int, side: str | None, seed: int) -> "Show":
    from evaluation.shows import between, recorded

    if match is None:
        if not refs:
            raise InvalidReference("name who plays, such as connect_four@champion, or a recorded --match")
        return between(refs, registry, side, seed)
    if refs:
        raise InvalidReference(f"match {match} says who plays: leave out {', '.join(refs)}")
    return recorded(match, game, registry, chances=True)


def _tell(caption: "Caption") -> None:
    did = [f"{line.name} {line.action}".strip() for line in caption.lines if line.acted]
    say(f"{caption.step}: {', '.join(did)}" if did else caption.step)


def _ending(show: "Show", done: "Film") -> str:
    """`33 steps; player_0 (connect_four@3) +1, player_1 (script:random) -1`; of many agents the mean of each player."""
    if len(show.cast) <= 4:
        got = [f"{agent} ({ref}) {done.returns[agent]:+g}" for agent, ref in show.cast.items()]
    else:
        own = {ref: [agent for agent in show.cast if show.cast[agent] == ref] for ref in show.cast.values()}
        got = [f"{ref} {sum(map(done.returns.__getitem__, a)) / len(a):+.3g} on average" for ref, a in own.items()]
    note = f"; {show.note}" if show.note and done.is_whole else ""
    return f"{done.steps} steps; returns: {', '.join(got)}{note}"
