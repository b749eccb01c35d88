import re
from pathlib import Path
from xml.etree import ElementTree

import pytest

from evaluation.pages import charts
from evaluation.pages.charts import Level, Point

POINTS = [
    Point(1, "duel@1", -40.0, (-90.0, 10.0), was_champion=False),
    Point(2, "duel@2", 120.0, (60.0, 190.0), was_champion=True),
    Point(4, "duel@4", 310.0, None, was_champion=True, mark="@4 champion"),
]
LEVELS = [Level("random", 0.0), Level("one_ply", 395.0), Level("mirror", 390.0)]


def parsed(chart: str) -> ElementTree.Element:
    return ElementTree.fromstring(chart)


def numbers(tree: ElementTree.Element, tag: str, kind: str, name: str) -> list[float]:
    return [float(mark.get(name, "")) for mark in tree.iter(tag) if kind in mark.get("class", "").split()]


def inside(tree: ElementTree.Element) -> bool:
    """Whether every mark and the foot of every text lies in the picture."""
    width, height = float(tree.get("width", "")), float(tree.get("height", ""))
    xs = [float(mark.get(name, "0")) for mark in tree.iter() for name in ("x", "x1", "x2", "cx")]
    ys = [float(mark.get(name, "0")) for mark in tree.iter() for name in ("y", "y1", "y2", "cy")]
    return 0 <= min(xs) <= max(xs) <= width and 0 <= min(ys) <= max(ys) <= height


def test_ratings_are_higher_up_the_higher_they_are_and_all_are_in_the_picture() -> None:
    tree = parsed(charts.ratings(POINTS, LEVELS, "what it shows"))
    (ordinary,) = numbers(tree, "circle", "dot", "cy")
    titles = [title.text for title in tree.iter("title")]
    assert titles == ["duel@1: −40 [−90, +10]", "duel@2: +120 [+60, +190]", "duel@4: +310"]
    levels = dict(zip((level.name for level in LEVELS), numbers(tree, "line", "level", "y1"), strict=True))
    assert levels["one_ply"] < levels["mirror"] < levels["random"] < ordinary
    assert len([mark for mark in tree.iter("polygon") if mark.get("class") == "dot"]) == 2, "who became champion"
    assert inside(tree)


def test_names_of_scripts_do_not_lie_on_one_another() -> None:
    tree = parsed(charts.ratings(POINTS, LEVELS, "what it shows"))
    places = sorted(
        float(t.get("y", "")) for t in tree.iter("text") if (t.text or "").startswith(("one_ply", "mirror"))
    )
    assert places[1] - places[0] >= 15


def test_one_version_alone_is_a_chart() -> None:
    tree = parsed(charts.ratings(POINTS[:1], [], "what it shows"))
    assert [text.text for text in tree.iter("text") if text.get("class") == "tick"][-1] == "1", "no other version"
    assert inside(tree)


@pytest.mark.parametrize(
    ("curve", "end"),
    [([1.0, 2.0, 3.1], "upper"), ([-1.0, -3.0], "lower"), ([0.5, -0.5], "between"), ([], "between")],
)
def test_the_evidence_ends_in_the_colour_of_the_bound_that_it_reached(curve: list[float], end: str) -> None:
    tree = parsed(charts.evidence(curve, (-2.94, 2.94), "what it shows"))
    assert [mark.get("class") for mark in tree.iter("circle")] == [f"end {end}"]
    (way,) = [mark.get("points", "").split() for mark in tree.iter("polyline")]
    assert len(way) == len(curve) + 1
    assert {text.text for text in tree.iter("text")} >= {"promote at +2.94", "reject at −2.94"}
    assert inside(tree)


def test_a_long_curve_is_thinned_and_keeps_its_end() -> None:
    tree = parsed(charts.evidence([i / 1000 for i in range(4003)], (-5, 5), "what it shows"))
    (way,) = [mark.get("points", "").split() for mark in tree.iter("polyline")]
    assert len(way) <= charts.MOST_POINTS + 2
    (x,), (y,) = numbers(tree, "circle", "end", "cx"), numbers(tree, "circle", "end", "cy")
    assert way[-1] == f"{x:.1f},{y:.1f}"


def test_what_is_written_is_text_not_markup() -> None:
    hostile = '"><script>alert(1)</script>'
    point = Point(1, hostile, 0.0, None, was_champion=False, mark=hostile)
    chart = charts.ratings([point], [Level(hostile, 1.0)], hostile)
    assert "<script" not in chart
    assert parsed(chart).get("aria-label") == hostile


def test_a_row_s_picture_is_for_the_eye_alone() -> None:
    for chart in (charts.whisker(10, (-5, 30), (-100, 200)), charts.bar(0.2, (0.0, 0.7))):
        assert parsed(chart).get("aria-hidden") == "true"
        assert inside(parsed(chart))


def test_the_ink_of_each_cell_of_the_heat_map_is_legible() -> None:
    """WCAG 2.2, 1.4.3: a contrast of 4.5 at least."""
    css = (Path(charts.__file__).parent / "templates" / "charts.css").read_text()
    cells = re.findall(r"\.h(\d+) \{ background: #(\w{6}); color: #(\w{6}); \}", css)
    assert [int(step) for step, _, _ in cells] == [*range(11), *range(11)], "light, and dark"
    assert min(contrast(fill, ink) for _, fill, ink in cells) >= 4.5


def contrast(one: str, other: str) -> float:
    high, low = sorted((luminance(one), luminance(other)), reverse=True)
    return (high + 0.05) / (low + 0.05)


def luminance(color: str) -> float:
    parts = [int(color[i : i + 2], 16) / 255 for i in (0, 2, 4)]
    red, green, blue = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue
