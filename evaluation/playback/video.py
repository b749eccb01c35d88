"""Renders games as GIF or WebP videos with captions, as data URIs, or in a window."""

from __future__ import annotations

import os
import sys
import tempfile
import time
from base64 import b64encode
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import cache
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageColor, ImageDraw, ImageFont, ImageSequence
from PIL.TiffImagePlugin import AppendingTiffWriter

from evaluation.playback.captions import Caption, Captions, Line
from evaluation.playback.environment_hooks import environment_hooks
from evaluation.playback.replay import GameSource
from league.config.environment import EnvironmentConfig
from league.environments.building import build
from league.environments.implementation import stock_stepping
from league.errors import ConfigError, EnvironmentMismatch
from league.files import disk_errors, replacing

PALETTE_SIZE = 48


def data_uri(pixels: NDArray, largest: int) -> str:
    """Convert an image (height, width, 3) of uint8 to a PNG data URI with at most `largest` pixels per side.

    Images below half of that are enlarged by a whole factor, so that pixels stay square and sharp.
    """
    image = Image.fromarray(np.ascontiguousarray(pixels))
    longer = max(image.size)
    factor = largest / longer if longer > largest else max(1, largest // 2 // longer)
    size = (max(1, round(image.width * factor)), max(1, round(image.height * factor)))
    scaled = image.resize(size, Image.Resampling.NEAREST if factor >= 1 else Image.Resampling.HAMMING)
    # Unlike a median cut, an octree keeps the colours of small objects, in a tenth of the time.
    few = scaled.quantize(PALETTE_SIZE, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    out = BytesIO()
    few.save(out, "PNG", optimize=True)
    return f"data:image/png;base64,{b64encode(out.getvalue()).decode()}"


LARGEST = 640
"""Maximum longer side of the image, in pixels."""
SMALLEST = 320
"""Smaller images are enlarged towards this by a whole factor."""
NARROWEST = 560
"""Minimum width for captions, in pixels."""

MARGIN, HEAD, LABELS, ROW = 14, 34, 20, 30
ACTION = 54
"""Width of a short action, in pixels."""
BACKGROUND, PANEL, RULE = (17, 20, 24), (25, 29, 35), (48, 54, 63)
TEXT, DIM = (233, 236, 239), (139, 147, 158)
COLORS = ((88, 166, 255), (255, 166, 77), (99, 201, 133), (219, 124, 214), (240, 98, 104), (240, 214, 98))
"""One per contestant, unless the environment declares colours of agents."""


class FrameComposer:
    """Composes the frames of a video. The first image determines their size."""

    def __init__(self, picture: NDArray, lines: int) -> None:
        """picture: first image. lines: lines per caption."""
        height, width = picture.shape[:2]
        self._picture = _fitted(width, height)
        self._size = max(NARROWEST, self._picture[0]), HEAD + self._picture[1] + LABELS + ROW * lines + MARGIN // 2

    @property
    def _action_at(self) -> int:
        return int(self._size[0] * 0.42)

    def compose(self, picture: NDArray, caption: Caption) -> Image.Image:
        """Image (height, width, 3) of uint8 → frame."""
        frame = Image.new("RGB", self._size, BACKGROUND)
        enlarges = picture.shape[1] < self._picture[0]
        scaled = Image.fromarray(np.ascontiguousarray(picture)).resize(
            self._picture, Image.Resampling.NEAREST if enlarges else Image.Resampling.LANCZOS
        )
        frame.paste(scaled, ((self._size[0] - self._picture[0]) // 2, HEAD))
        draw = ImageDraw.Draw(frame)
        self._head(draw, caption)
        top = HEAD + self._picture[1]
        draw.rectangle((0, top, self._size[0], self._size[1]), fill=PANEL)
        middle = top + LABELS // 2 + 3
        draw.text((self._action_at, middle), "action", DIM, _font(11), "lm")
        draw.text((self._size[0] - MARGIN, middle), "return", DIM, _font(11), "rm")
        if any(line.action and line.chances for line in caption.lines):
            draw.text((self._action_at + ACTION, middle), "probabilities", DIM, _font(11), "lm")
        for number, line in enumerate(caption.lines):
            self._line(draw, top + LABELS + ROW * number, line)
        return frame

    def _head(self, draw: ImageDraw.ImageDraw, caption: Caption) -> None:
        right = self._size[0] - MARGIN
        draw.text((right, HEAD // 2), caption.step, TEXT, _font(15), "rm")
        room = right - int(_font(15).getlength(caption.step)) - 2 * MARGIN
        draw.text((MARGIN, HEAD // 2), _cut(caption.title, 15, room), DIM, _font(15), "lm")

    def _line(self, draw: ImageDraw.ImageDraw, top: int, line: Line) -> None:
        width, middle = self._size[0], top + ROW // 2
        color = COLORS[line.color % len(COLORS)]  # of the contestant, or of the agents in the picture
        with suppress(ValueError):  # a colour that Pillow does not know
            if line.shade is not None:
                color = ImageColor.getrgb(line.shade)[:3]
        bright = TEXT if line.acted else DIM
        action_at, value_at = self._action_at, width - MARGIN
        draw.ellipse((MARGIN, middle - 5, MARGIN + 10, middle + 5), color if line.acted else PANEL, color, 2)
        name = _cut(line.name, 15, action_at - 40)
        draw.text((MARGIN + 20, middle), name, bright, _font(15), "lm")
        after = MARGIN + 28 + int(_font(15).getlength(name))
        draw.text((after, middle), _cut(line.ref, 13, action_at - after - 8), DIM, _font(13), "lm")
        draw.text((value_at, middle), f"{line.value:+.2f}", bright, _font(15), "rm")
        end = value_at - max(64, int(_font(15).getlength(f"{line.value:+.2f}")) + 12)
        if not line.chances:
            draw.text((action_at, middle), _cut(line.action, 15, end - action_at), bright, _font(15), "lm")
            return
        start = action_at
        if line.action:
            draw.text((action_at, middle), line.action, bright, _font(15), "lm")
            start += max(ACTION, int(_font(15).getlength(line.action)) + 14)
        self._chances(draw, line, (start, end), middle, color if line.acted else DIM)

    def _chances(
        self, draw: ImageDraw.ImageDraw, line: Line, span: tuple[int, int], middle: int, color: tuple[int, int, int]
    ) -> None:
        """As many probabilities as fit, each above a bar."""
        cell = 68
        for place, (action, chance) in enumerate(line.chances[: max(1, (span[1] - span[0]) // cell)]):
            left = span[0] + cell * place
            right = left + cell - 10
            draw.text((left, middle - 3), action, TEXT if line.acted else DIM, _font(13), "lm")
            draw.text((right, middle - 3), f"{100 * chance:.0f} %", DIM, _font(13), "rm")
            draw.rectangle((left, middle + 8, right, middle + 10), RULE)
            if (filled := round((right - left) * chance)) > 0:
                draw.rectangle((left, middle + 8, left + filled, middle + 10), color)


def _fitted(width: int, height: int) -> tuple[int, int]:
    longer = max(width, height)
    if longer > LARGEST:
        return max(1, round(width * LARGEST / longer)), max(1, round(height * LARGEST / longer))
    factor = max(1, SMALLEST // longer)
    return width * factor, height * factor


@cache
def _font(size: int) -> ImageFont.FreeTypeFont:
    font = ImageFont.load_default(size)
    assert isinstance(font, ImageFont.FreeTypeFont), "Pillow's own font is a scalable one"
    return font


def _cut(text: str, size: int, room: float) -> str:
    """`text`, truncated to `room` pixels with an ellipsis."""
    font = _font(size)
    if font.getlength(text) <= room:
        return text
    while text and font.getlength(text + "…") > room:
        text = text[:-1]
    return text + "…" if text else ""


FORMATS = {".gif": "GIF", ".webp": "WEBP"}

TURNS_PER_SECOND = 2.0
"""Frame rate if agents act one after another."""
STEPS_PER_SECOND = 10.0
"""Frame rate if agents act simultaneously."""
LAST_FRAME = 2.0
"""Seconds that the last frame is shown."""

CaptionListener = Callable[[Caption], None]
"""Receives each step as it is shown."""


@dataclass(frozen=True, slots=True)
class VideoSummary:
    """Summary of a shown game. is_whole: whether the game ended."""

    steps: int
    returns: dict[str, float]
    is_whole: bool


def write_video(
    source: GameSource,
    out: Path,
    fps: float | None = None,
    max_frames: int = 500,
    listener: CaptionListener | None = None,
) -> VideoSummary:
    """Write a game to `out` atomically.

    Frames are buffered in a temporary file, so that memory does not grow with the length of the video, except for one
    byte per pixel and frame in Pillow's GIF encoder.

    Args:
        source: The game.
        out: File with the suffix .gif or .webp.
        fps: Steps per second; by default slower if agents take turns.
        max_frames: Maximum number of frames.
        listener: Receives each caption.

    Raises:
        ConfigError: Unknown suffix.
        EnvironmentMismatch: The environment renders no images.
        StorageError: The file cannot be written.
    """
    if out.suffix.lower() not in FORMATS:
        raise ConfigError(f"--out {out}: expected a name that ends in {' or '.join(FORMATS)}")
    _require(source, "rgb_array")
    shades = environment_hooks(source.config.environment).declared.agent_colors
    captions = Captions(source.title, source.interface, source.controllers, shades)
    frames, turns, last = None, True, None
    stepping = stock_stepping(source.config.environment, 1, render_mode="rgb_array")
    with closing(stepping) as environment, tempfile.TemporaryFile() as spool:
        with AppendingTiffWriter(spool) as writer:
            for last in islice(source.play(environment), max_frames):
                picture, caption = environment.render(0), captions.of(last)
                frames = frames or FrameComposer(picture, len(caption.lines))
                frames.compose(picture, caption).save(writer, "TIFF", compression="tiff_adobe_deflate")
                writer.newFrame()
                turns = turns and len(last.moves) <= 1
                if listener:
                    listener(caption)
        assert last is not None, "a game has at least one step"
        pace = 1 / (fps or (TURNS_PER_SECOND if turns else STEPS_PER_SECOND))
        _write(spool, out, [pace] * last.step + [max(LAST_FRAME, pace)])
    return VideoSummary(last.step, last.returns, last.is_over)


def show_window(source: GameSource, fps: float | None = None, listener: CaptionListener | None = None) -> VideoSummary:
    """Show a game in the environment's own window, at `fps` steps per second or at the environment's pace.

    Raises EnvironmentMismatch without a display, or if the environment has no window.
    """
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise EnvironmentMismatch(
            "--watch needs a display, but DISPLAY and WAYLAND_DISPLAY are not set: use --out game.gif"
        )
    _require(source, "human")
    captions, last = Captions(source.title, source.interface, source.controllers), None
    with closing(stock_stepping(source.config.environment, 1, render_mode="human")) as environment:
        for last in source.play(environment):
            if listener:
                listener(captions.of(last))
            if fps:
                time.sleep(1 / fps)
    assert last is not None, "a game has at least one step"
    return VideoSummary(last.step, last.returns, last.is_over)


def render_modes(config: EnvironmentConfig) -> list[str]:
    """Render modes that the environment declares."""
    with closing(build(config)) as environment:
        metadata = getattr(environment, "metadata", None) or {}
    return [str(mode) for mode in metadata.get("render_modes") or ()]


def _require(source: GameSource, mode: str) -> None:
    modes = render_modes(source.config.environment)
    if mode not in modes:
        raise EnvironmentMismatch(
            f"{source.config.environment.entry_point} cannot be rendered: it has no render_mode {mode!r}"
            f" (it has {', '.join(modes) or 'none'})"
        )


def _write(spool: IO[bytes], out: Path, seconds: Sequence[float]) -> None:
    kind = FORMATS[out.suffix.lower()]
    with disk_errors(out, action="written"), replacing(out) as part, Image.open(spool) as frames:
        # GIF: Pillow's own choice of colours, a median cut, loses those of the small discs of the legend.
        few = (frame.quantize(method=Image.Quantize.FASTOCTREE) for frame in ImageSequence.Iterator(frames))
        first, later_frames = (next(few), few) if kind == "GIF" else (frames, ())
        first.save(
            part,
            kind,
            save_all=True,
            append_images=later_frames,
            duration=[round(1000 * duration) for duration in seconds],
            loop=0,
            quality=85,
        )
