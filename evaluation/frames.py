"""Frames of a film: a picture of the game with its caption below, all of one size."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from evaluation.captions import Caption, Line

LARGEST = 640
"""Pixels that the longer side of the picture has at most."""
SMALLEST = 320
"""Smaller pictures are enlarged towards this by a whole factor, so that their pixels stay square and sharp."""
NARROWEST = 560
"""Pixels that a caption needs in width."""

MARGIN, HEAD, LABELS, ROW = 14, 34, 20, 30
ACTION = 54
"""Pixels of a short action."""
BACKGROUND, PANEL, RULE = (17, 20, 24), (25, 29, 35), (48, 54, 63)
TEXT, DIM = (233, 236, 239), (139, 147, 158)
COLORS = ((88, 166, 255), (255, 166, 77), (99, 201, 133), (219, 124, 214), (240, 98, 104), (240, 214, 98))
"""One of each contestant."""


class Frames:
    """Composes frames of one film; the first one decides their size."""

    def __init__(self, picture: NDArray, lines: int) -> None:
        """picture: of the beginning. lines: of the captions."""
        height, width = picture.shape[:2]
        self._picture = _fitted(width, height)
        self._size = max(NARROWEST, self._picture[0]), HEAD + self._picture[1] + LABELS + ROW * lines + MARGIN // 2

    @property
    def _action_at(self) -> int:
        return int(self._size[0] * 0.42)

    def compose(self, picture: NDArray, caption: Caption) -> Image.Image:
        """picture (height, width, 3) uint8 → a frame."""
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
        self._labels(draw, top, caption)
        for number, line in enumerate(caption.lines):
            self._line(draw, top + LABELS + ROW * number, line)
        return frame

    def _head(self, draw: ImageDraw.ImageDraw, caption: Caption) -> None:
        right = self._size[0] - MARGIN
        draw.text((right, HEAD // 2), caption.step, TEXT, _font(15), "rm")
        room = right - int(_font(15).getlength(caption.step)) - 2 * MARGIN
        draw.text((MARGIN, HEAD // 2), _cut(caption.title, 15, room), DIM, _font(15), "lm")

    def _labels(self, draw: ImageDraw.ImageDraw, top: int, caption: Caption) -> None:
        middle, likely = top + LABELS // 2 + 3, [line for line in caption.lines if line.chances]
        draw.text((self._action_at, middle), "action", DIM, _font(11), "lm")
        draw.text((self._size[0] - MARGIN, middle), "return", DIM, _font(11), "rm")
        if any(line.action for line in likely):
            draw.text((self._action_at + ACTION, middle), "probabilities", DIM, _font(11), "lm")

    def _line(self, draw: ImageDraw.ImageDraw, top: int, line: Line) -> None:
        width, middle = self._size[0], top + ROW // 2
        color = COLORS[line.color % len(COLORS)]
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
        """As many probabilities as find room, each over a bar that it fills."""
        cell = 68
        for place, (action, chance) in enumerate(line.chances[: max(1, (span[1] - span[0]) // cell)]):
            left = span[0] + cell * place
            right = left + cell - 10
            draw.text((left, middle - 3), action, TEXT if line.acted else DIM, _font(13), "lm")
            draw.text((right, middle - 3), f"{chance:.0%}", DIM, _font(13), "rm")
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
    """`text`, or as much of it as has room, with an ellipsis."""
    font = _font(size)
    if font.getlength(text) <= room:
        return text
    while text and font.getlength(text + "…") > room:
        text = text[:-1]
    return text + "…" if text else ""
