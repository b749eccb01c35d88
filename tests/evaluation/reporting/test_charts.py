import re
from pathlib import Path
from xml.etree import ElementTree

import pytest

from evaluation.reporting import charts
from evaluation.reporting.charts import RatingLevel, RatingPoint

POINTS = [
    RatingPoint(1, "duel@1", -40.0, (-90.0, 10.0), was_champion=False),
    RatingPoint(2, "duel@2", 120.0, (60.0, 190.0), was_champion=True),
    RatingPoint(4, "duel@4", 310.0, None, was_champion=True, mark="@4 champion"),
]
LEVELS = [RatingLevel("random", 0.0), RatingLevel("one_ply", 395.0), RatingLevel("mirror", 390.0)]


def parsed(chart: str) -> ElementTree.Element:
    return ElementTree.fromstring(chart)


def numbers(tree: ElementTree.Element, tag: str, kind: str, name: str) -> list[float]:
    return [float(mark.get(name, "")) for mark in tree.iter(tag) if kind in mark.get("class", "").split()]


def is_inside(tree: ElementTree.Element) -> bool:
    """Whether all marks and the origin of each text are inside the chart."""
    width, height = float(tree.get("width", "")), float(tree.get("height", ""))
    xs = [float(mark.get(name, "0")) for mark in tree.iter() for name in ("x", "x1", "x2", "cx")]
    ys = [float(mark.get(name, "0")) for mark in tree.iter() for name in ("y", "y1", "y2", "cy")]
    return 0 <= min(xs) <= max(xs) <= width and 0 <= min(ys) <= max(ys) <= height


def test_higher_ratings_are_higher_in_the_chart() -> None:
    tree = parsed(charts.ratings(POINTS, LEVELS, "what it shows"))
    (ordinary,) = numbers(tree, "circle", "dot", "cy")
    titles = [title.text for title in tree.iter("title")]
    assert titles == ["duel@1: −40 [−90, +10]", "duel@2: +120 [+60, +190]", "duel@4: +310"]
    levels = dict(zip((level.name for level in LEVELS), numbers(tree, "line", "level", "y1"), strict=True))
    assert levels["one_ply"] < levels["mirror"] < levels["random"] < ordinary
    assert len([mark for mark in tree.iter("polygon") if mark.get("class") == "dot"]) == 2, (
        "champions have another mark"
    )
    assert is_inside(tree)


def test_script_names_do_not_overlap() -> None:
    tree = parsed(charts.ratings(POINTS, LEVELS, "what it shows"))
    places = sorted(
        float(t.get("y", "")) for t in tree.iter("text") if (t.text or "").startswith(("one_ply", "mirror"))
    )
    assert places[1] - places[0] >= 15


def test_a_single_version_has_a_chart() -> None:
    tree = parsed(charts.ratings(POINTS[:1], [], "what it shows"))
    assert [text.text for text in tree.iter("text") if text.get("class") == "tick"][-1] == "1", "only version 1"
    assert is_inside(tree)


@pytest.mark.parametrize(
    ("curve", "end"),
    [([1.0, 2.0, 3.1], "upper"), ([-1.0, -3.0], "lower"), ([0.5, -0.5], "between"), ([], "between")],
)
def test_the_end_of_the_evidence_has_the_colour_of_its_bound(curve: list[float], end: str) -> None:
    tree = parsed(charts.evidence(curve, (-2.94, 2.94), "what it shows"))
    assert [mark.get("class") for mark in tree.iter("circle")] == [f"end {end}"]
    (line,) = [mark.get("points", "").split() for mark in tree.iter("polyline")]
    assert len(line) == len(curve) + 1
    assert {text.text for text in tree.iter("text")} >= {"promote at +2.94", "reject at −2.94"}
    assert is_inside(tree)


def test_a_long_curve_is_thinned_and_keeps_its_end() -> None:
    tree = parsed(charts.evidence([i / 1000 for i in range(4003)], (-5, 5), "what it shows"))
    (line,) = [mark.get("points", "").split() for mark in tree.iter("polyline")]
    assert len(line) <= charts.MOST_POINTS + 2
    (x,), (y,) = numbers(tree, "circle", "end", "cx"), numbers(tree, "circle", "end", "cy")
    assert line[-1] == f"{x:.1f},{y:.1f}"


def test_text_is_escaped() -> None:
    hostile = '"><script>alert(1)</script>'
    point = RatingPoint(1, hostile, 0.0, None, was_champion=False, mark=hostile)
    chart = charts.ratings([point], [RatingLevel(hostile, 1.0)], hostile)
    assert "<script" not in chart
    assert parsed(chart).get("aria-label") == hostile


def test_charts_in_rows_are_hidden_from_screen_readers() -> None:
    for chart in (charts.whisker(10, (-5, 30), (-100, 200)), charts.bar(0.2, (0.0, 0.7))):
        assert parsed(chart).get("aria-hidden") == "true"
        assert is_inside(parsed(chart))


def test_the_contrast_of_heat_map_cells_is_sufficient() -> None:
    """WCAG 2.2, 1.4.3: a contrast of at least 4.5."""
    css = (Path(charts.__file__).parent / "templates" / "charts.css").read_text()
    cells = re.findall(r"\.h(\d+) \{ background: #(\w{6}); color: #(\w{6}); \}", css)
    assert [int(step) for step, _, _ in cells] == [*range(11), *range(11)], "light and dark theme"
    assert min(contrast(fill, ink) for _, fill, ink in cells) >= 4.5


def contrast(one: str, other: str) -> float:
    high, low = sorted((luminance(one), luminance(other)), reverse=True)
    return (high + 0.05) / (low + 0.05)


def luminance(color: str) -> float:
    parts = [int(color[i : i + 2], 16) / 255 for i in (0, 2, 4)]
    red, green, blue = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue
