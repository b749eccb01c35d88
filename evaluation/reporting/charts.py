"""Charts of a league as inline SVG: ratings, evidence, intervals, and their scales.

Colours and fonts come from charts.css by class, so that charts fit light and dark pages and print. Each chart has an
`aria-label`, and each mark a `title`. Text is escaped.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from xml.etree import ElementTree

from markupsafe import Markup


@dataclass(frozen=True, slots=True)
class Scale:
    """Linear scale from the values low and high to the pixels `start` and `end`."""

    low: float
    high: float
    start: float
    end: float

    def at(self, value: float) -> float:
        """The pixel of a value."""
        return self.start + (value - self.low) / (self.high - self.low) * (self.end - self.start)

    def ticks(self, about: int, whole: bool = False) -> list[float]:
        """About `about` round numbers between low and high. whole: integers only."""
        step = _step((self.high - self.low) / about)
        if whole:
            step = max(1.0, step)
        first, last = math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9)
        return [number * step for number in range(first, last + 1)]


def _step(rough: float) -> float:
    """The smallest of 1, 2 and 5 times a power of ten that is at least `rough`."""
    power = 10.0 ** math.floor(math.log10(rough))
    return next(factor * power for factor in (1, 2, 5, 10) if factor * power >= rough * (1 - 1e-9))


def padded(low: float, high: float, share: float = 0.06, least: float = 1.0) -> tuple[float, float]:
    """The range with padding on both sides, at least `least` wide."""
    room = max(share * (high - low), (least - (high - low)) / 2)
    return low - room, high + room


def apart(places: list[float], least: float) -> list[float]:
    """`places`, in their order, moved down just enough to be `least` apart."""
    moved: dict[int, float] = {}
    last = -math.inf
    for index in sorted(range(len(places)), key=places.__getitem__):
        last = moved[index] = max(places[index], last + least)
    return [moved[index] for index in range(len(places))]


Element = ElementTree.Element
Span = tuple[float, float]

MOST_POINTS = 400
"""Points of a curve."""


@dataclass(frozen=True, slots=True)
class RatingPoint:
    """A version in the rating chart. name: tooltip. mark: text above it, or None."""

    number: int
    name: str
    rating: float
    interval: Span | None
    was_champion: bool
    mark: str | None = None


@dataclass(frozen=True, slots=True)
class RatingLevel:
    """A constant rating, of a script."""

    name: str
    rating: float


def ratings(points: Sequence[RatingPoint], levels: Sequence[RatingLevel], label: str) -> Markup:
    """Ratings over version numbers with intervals. Former champions are filled; `levels` are dashed lines."""
    width, height, left, right, top, bottom = 820, 320, 54, 100, 30, 42
    ends = [bound for point in points for bound in (*(point.interval or ()), point.rating)]
    ends += [0.0, *(level.rating for level in levels)]
    low, high = padded(min(ends), max(ends), least=100)
    y = Scale(low, high, height - bottom, top)
    x = Scale(*padded(points[0].number, points[-1].number, 0.03, least=2), left, width - right)
    svg = _svg(width, height, label)
    _grid(svg, x, y, "version", "Elo", (points[0].number, points[-1].number))
    names = apart([y.at(level.rating) for level in levels], 15)
    for level, place in zip(levels, names, strict=True):
        _line(svg, (left, y.at(level.rating)), (width - right, y.at(level.rating)), "level")
        _add(svg, "text", f"{level.name} {signed(level.rating)}", x=width - right + 8, y=place + 4, class_="label")
    way = " ".join(f"{x.at(point.number):.1f},{y.at(point.rating):.1f}" for point in points)
    _add(svg, "polyline", points=way, class_="way")
    for point in points:
        _point(svg, point, x.at(point.number), y)
    return _markup(svg)


def _point(svg: Element, point: RatingPoint, x: float, y: Scale) -> None:
    group = _add(svg, "g", class_="champion" if point.was_champion else "version")
    span = f" [{', '.join(map(signed, point.interval))}]" if point.interval else ""
    _add(group, "title", f"{point.name}: {signed(point.rating)}{span}")
    if point.interval:
        low, high = (y.at(bound) for bound in point.interval)
        _line(group, (x, low), (x, high), "interval")
        for end in (low, high):
            _line(group, (x - 3, end), (x + 3, end), "interval")
    middle = y.at(point.rating)
    if point.was_champion:
        corners = ((x, middle - 6), (x + 6, middle), (x, middle + 6), (x - 6, middle))
        _add(group, "polygon", points=" ".join(f"{a:.1f},{b:.1f}" for a, b in corners), class_="dot")
    else:
        _add(group, "circle", cx=x, cy=middle, r=4, class_="dot")
    if point.mark:
        top = y.at(point.interval[1]) if point.interval else middle
        _add(group, "text", point.mark, x=x, y=max(12, top - 8), text_anchor="middle", class_="label strong")


def evidence(curve: Sequence[float], bounds: Span, label: str) -> Markup:
    """LLR after each block between the bounds of rejection and promotion. The end has the colour of the bound it
    reached.
    """
    width, height, left, right, top, bottom = 440, 208, 40, 14, 22, 40
    low, high = padded(min(*bounds, *curve), max(*bounds, *curve), 0.12)
    y = Scale(low, high, height - bottom, top)
    x = Scale(0, max(1, len(curve)), left, width - right)
    svg = _svg(width, height, label)
    _grid(svg, x, y, "blocks", "LLR", (x.low, x.high))
    lower, upper = bounds
    for bound, what, name in (
        (upper, f"promote at {signed(upper, 2)}", "upper"),
        (lower, f"reject at {signed(lower, 2)}", "lower"),
    ):
        _line(svg, (left, y.at(bound)), (width - right, y.at(bound)), f"bound {name}")
        above = -5 if bound == upper else 14
        _add(svg, "text", what, x=left + 5, y=y.at(bound) + above, class_=f"label {name}")
    stride = -(-len(curve) // MOST_POINTS) if curve else 1
    steps = [
        (0, 0.0),
        *((block, llr) for block, llr in enumerate(curve, 1) if block % stride == 0 or block == len(curve)),
    ]
    _add(svg, "polyline", points=" ".join(f"{x.at(b):.1f},{y.at(llr):.1f}" for b, llr in steps), class_="curve")
    block, llr = steps[-1]
    reached = "upper" if llr >= upper else "lower" if llr <= lower else "between"
    end = _add(svg, "circle", cx=x.at(block), cy=y.at(llr), r=4.5, class_=f"end {reached}")
    _add(end, "title", f"LLR {signed(llr, 2)} after {block} blocks")
    return _markup(svg)


def whisker(value: float, interval: Span | None, span: Span) -> Markup:
    """A value with its interval on a line from span[0] to span[1], for a table row with the numbers as text."""
    width, height = 150, 18
    x = Scale(*padded(*span, least=1), 4, width - 4)
    svg = _svg(width, height, None)
    if span[0] <= 0 <= span[1]:
        _line(svg, (x.at(0), 1), (x.at(0), height - 1), "zero")
    if interval:
        _line(svg, (x.at(interval[0]), height / 2), (x.at(interval[1]), height / 2), "interval")
    _add(svg, "circle", cx=x.at(value), cy=height / 2, r=3.5, class_="dot")
    return _markup(svg)


def bar(share: float, interval: Span) -> Markup:
    """A share with its interval, for a table row that contains the numbers as text."""
    width, height = 110, 14
    x = Scale(0, 1, 2, width - 2)
    svg = _svg(width, height, None)
    _add(svg, "rect", x=x.at(0), y=3, width=width - 4, height=8, class_="empty")
    _add(svg, "rect", x=x.at(0), y=3, width=x.at(share) - x.at(0), height=8, class_="full")
    _line(svg, (x.at(interval[0]), height / 2), (x.at(interval[1]), height / 2), "interval")
    return _markup(svg)


def _grid(svg: Element, x: Scale, y: Scale, below: str, beside: str, numbered: Span) -> None:
    """Grid lines and axis labels. numbered: range of the labels on the x axis."""
    for value in y.ticks(7):
        _line(svg, (x.start, y.at(value)), (x.end, y.at(value)), "zero" if value == 0 else "grid")
        _add(svg, "text", _number(value), x=x.start - 7, y=y.at(value) + 4, text_anchor="end", class_="tick")
    for value in x.ticks(8, whole=True):
        if not numbered[0] <= value <= numbered[1]:
            continue
        _line(svg, (x.at(value), y.start), (x.at(value), y.start + 4), "grid")
        _add(svg, "text", _number(value), x=x.at(value), y=y.start + 17, text_anchor="middle", class_="tick")
    _add(svg, "text", below, x=(x.start + x.end) / 2, y=y.start + 34, text_anchor="middle", class_="axis")
    _add(svg, "text", beside, x=x.start - 7, y=max(10, y.end - 12), text_anchor="end", class_="axis")


def signed(value: float, digits: int = 0) -> str:
    """`+12`, `−3`, `0` with a minus sign as wide as the plus."""
    text = f"{value:+.{digits}f}".replace("-", "−")
    return text if float(text[1:]) else text[1:]


def _number(value: float) -> str:
    return f"{value + 0.0:g}".replace("-", "−")


def _svg(width: int, height: int, label: str | None) -> Element:
    """label: description; None if the text next to it describes the chart."""
    svg = ElementTree.Element("svg", {"viewBox": f"0 0 {width} {height}", "width": str(width), "height": str(height)})
    if label is None:
        svg.set("aria-hidden", "true")
    else:
        svg.set("role", "img")
        svg.set("aria-label", label)
    svg.set("class", "chart")
    return svg


def _line(parent: Element, start: Span, end: Span, class_: str) -> None:
    _add(parent, "line", x1=start[0], y1=start[1], x2=end[0], y2=end[1], class_=class_)


def _add(parent: Element, tag: str, text: str | None = None, **attributes: str | float) -> Element:
    written = {
        name.rstrip("_").replace("_", "-"): value if isinstance(value, str) else f"{value:.1f}"
        for name, value in attributes.items()
    }
    child = ElementTree.SubElement(parent, tag, written)
    child.text = text
    return child


def _markup(svg: Element) -> Markup:
    return Markup(ElementTree.tostring(svg, encoding="unicode"))
