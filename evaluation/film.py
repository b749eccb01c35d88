"""A game as a film: GIF or WebP, a frame for each step, or a window where there is a display."""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import IO

from PIL import Image
from PIL.TiffImagePlugin import AppendingTiffWriter

from evaluation.captions import Caption, Captions
from evaluation.frames import Frames
from evaluation.shows import Show
from league.config import EnvironmentConfig
from league.environments.building import build
from league.environments.lockstep import stepping
from league.errors import ConfigError, EnvironmentMismatch, StorageError

FORMATS = {".gif": "GIF", ".webp": "WEBP"}

TURNS_PER_SECOND = 2.0
"""Where agents act one after another; a person wants to look at each move."""
STEPS_PER_SECOND = 10.0
"""Where they act at once."""
LAST_FRAME = 2.0
"""Seconds that the end is shown."""

Listener = Callable[[Caption], None]
"""Told of each step as it is shown."""


@dataclass(frozen=True, slots=True)
class Film:
    """What was shown. is_whole: whether the game came to its end."""

    steps: int
    returns: dict[str, float]
    is_whole: bool


def film(
    show: Show,
    out: Path,
    fps: float | None = None,
    max_frames: int = 500,
    listener: Listener | None = None,
) -> Film:
    """Write the game to `out`, whole or not at all; its suffix says the format.

    fps: steps per second, by default slow where agents take turns.
    max_frames: the film ends there if the game does not.
    Frames wait in a temporary file, so that a film of any length takes the memory of a few of them (a GIF's in addition
    a byte per pixel and frame, by Pillow's encoder).
    Raises ConfigError for another suffix, EnvironmentMismatch if the environment gives no pictures, and StorageError.
    """
    if out.suffix.lower() not in FORMATS:
        raise ConfigError(f"--out {out}: expected a name that ends in {' or '.join(FORMATS)}")
    _require(show, "rgb_array")
    environment = stepping(show.config.environment, 1, render_mode="rgb_array")
    captions, frames, turns, last = Captions(show.title, show.interface, show.cast), None, True, None
    with closing(environment), tempfile.TemporaryFile() as spool:
        with AppendingTiffWriter(spool) as writer:
            for last in islice(show.play(environment), max_frames):
                picture, caption = environment.render(0), captions.of(last)
                frames = frames or Frames(picture, len(caption.lines))
                frames.compose(picture, caption).save(writer, "TIFF", compression="tiff_adobe_deflate")
                writer.newFrame()
                turns = turns and len(last.moves) <= 1
                if listener:
                    listener(caption)
        assert last is not None, "a game has a beginning"
        pace = 1 / (fps or (TURNS_PER_SECOND if turns else STEPS_PER_SECOND))
        _write(spool, out, [pace] * last.step + [max(LAST_FRAME, pace)])
    return Film(last.step, last.returns, last.is_over)


def watch(show: Show, fps: float | None = None, listener: Listener | None = None) -> Film:
    """Show the game in a window of the environment's own, at `fps` steps per second or the environment's pace.

    Raises EnvironmentMismatch where there is no display, or the environment has no window.
    """
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise EnvironmentMismatch(
            "--watch needs a display, and here is none (DISPLAY and WAYLAND_DISPLAY are not set): use --out game.gif"
        )
    _require(show, "human")
    environment = stepping(show.config.environment, 1, render_mode="human")
    captions, last = Captions(show.title, show.interface, show.cast), None
    with closing(environment):
        for last in show.play(environment):
            if listener:
                listener(captions.of(last))
            if fps:
                time.sleep(1 / fps)
    assert last is not None, "a game has a beginning"
    return Film(last.step, last.returns, last.is_over)


def render_modes(config: EnvironmentConfig) -> list[str]:
    """How an environment can be shown, by its own account."""
    environment = build(config)
    metadata = getattr(environment, "metadata", None) or {}
    environment.close()
    return [str(known) for known in metadata.get("render_modes") or ()]


def _require(show: Show, mode: str) -> None:
    modes = render_modes(show.config.environment)
    if mode not in modes:
        raise EnvironmentMismatch(
            f"{show.config.environment.entry_point} cannot be shown: it has no render_mode {mode!r}"
            f" (it has {', '.join(modes) or 'none'})"
        )


def _write(spool: IO[bytes], out: Path, seconds: Sequence[float]) -> None:
    part = out.with_name(f".{out.name}.part")
    try:
        with Image.open(spool) as frames:
            frames.save(
                part,
                FORMATS[out.suffix.lower()],
                save_all=True,
                duration=[round(1000 * each) for each in seconds],
                loop=0,
                quality=85,
            )
        part.replace(out)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise StorageError(f"{out} cannot be written: {error.strerror or error}") from error
