"""`league replay`: a game as an animated image or in a window."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from league.errors import InvalidReference
from policy_league.cli.options import MAX_SEED, open_registry
from policy_league.cli.output import console, say

if TYPE_CHECKING:
    from evaluation.playback.captions import Caption
    from evaluation.playback.replay import GameSource
    from evaluation.playback.video import VideoSummary
    from league.registry.registry import Registry


def replay(
    refs: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[REF]…",
            help="Contestants, such as connect_four@3 script:random. A single one plays against itself.",
        ),
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Output file (.gif or .webp).")] = Path("replay.gif"),
    seed: Annotated[int, typer.Option(min=0, max=MAX_SEED, help="Seed of the environment and of random scripts.")] = 0,
    side: Annotated[
        str | None, typer.Option(help="Side of the first REF; the others follow in order. Default: the first side.")
    ] = None,
    fps: Annotated[
        float | None,
        typer.Option(min=0.1, max=50, help="Steps per second. Default: 2 if agents take turns, else 10."),
    ] = None,
    max_frames: Annotated[int, typer.Option(min=1, help="Maximum number of frames.")] = 500,
    in_window: Annotated[
        bool, typer.Option("--watch", help="Show the game in a window instead of writing a file.")
    ] = False,
    match: Annotated[
        str | None, typer.Option(metavar="ID", help="ID of a recorded match in the ledger to replay.")
    ] = None,
    game: Annotated[int, typer.Option(min=0, help="Index of the game in the match.")] = 0,
) -> None:
    """Record a game as an animated image, or show it in a window.

    Plays a new game between versions or scripts, or replays a recorded match. Frames show the actions and their
    probabilities. Versions act greedily. If there are more sides than REFs, the last REF plays the remaining sides.
    """
    from evaluation.playback.video import show_window, write_video

    registry = open_registry()
    source = _source(registry, refs or [], match, game, side, seed)
    if in_window:
        done = show_window(source, fps, listener=_tell)
        say(_ending(source, done))
        return
    with console.status("") as status:
        done = write_video(
            source, out, fps, max_frames, listener=lambda caption: status.update(f"rendering {caption.step}")
        )
    say(f"{out}: {_ending(source, done)}")
    if not done.is_whole:
        say(f"The game continues after the last frame: --max-frames is {max_frames}.")


def _source(
    registry: "Registry", refs: list[str], match: str | None, game: int, side: str | None, seed: int
) -> "GameSource":
    from evaluation.playback.replay import live_game, recorded_game

    if match is None:
        if not refs:
            raise InvalidReference("expected a contestant, such as connect_four@champion, or --match ID")
        return live_game(refs, registry, side, seed)
    if refs:
        raise InvalidReference(f"--match replays recorded contestants: remove {', '.join(refs)}")
    return recorded_game(match, game, registry, chances=True)


def _tell(caption: "Caption") -> None:
    did = [f"{line.name} {line.action}".strip() for line in caption.lines if line.acted]
    say(f"{caption.step}: {', '.join(did)}" if did else caption.step)


def _ending(source: "GameSource", done: "VideoSummary") -> str:
    """`33 steps; player_0 (connect_four@3) +1, player_1 (script:random) -1`; of many agents the mean of each player."""
    if len(source.controllers) <= 4:
        got = [f"{agent} ({ref}) {done.returns[agent]:+g}" for agent, ref in source.controllers.items()]
    else:
        controllers = source.controllers
        agents_by_ref = {
            ref: [agent for agent in controllers if controllers[agent] == ref] for ref in controllers.values()
        }
        got = [
            f"{ref} {sum(map(done.returns.__getitem__, a)) / len(a):+.3g} on average"
            for ref, a in agents_by_ref.items()
        ]
    note = f"; {source.note}" if source.note and done.is_whole else ""
    return f"{done.steps} steps; returns: {', '.join(got)}{note}"
