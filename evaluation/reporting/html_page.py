"""Renders a league report as one self-contained HTML file without network access.

A Content-Security-Policy allows only its script and style, by digest, so that no text of a league, version or person
can run. All text is escaped.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterator, Sequence
from datetime import datetime
from functools import cache
from hashlib import sha256
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from evaluation.gating.verdict_evidence import VerdictEvidence
from evaluation.reporting import charts, wording
from evaluation.reporting.flipbook import Flipbook
from evaluation.reporting.league_report import LeagueReport
from evaluation.results import Confirmation, Difference, Standing
from evaluation.schedules.builders import ANCHOR
from league.files import disk_errors, replacing
from league.refs import short_verdict
from league.registry.changes import OPEN
from league.results.records import Scoring

TEMPLATES = Path(__file__).parent / "templates"
MOST_ROWS = 500
"""Rows of a table."""

CELLS = {3: ("lost", "drawn", "won"), 5: ("0 points", "½", "1", "1½", "2 points")}
"""Labels of a block's counts: results of one comparison, or points of two games."""

Interval = Sequence[float | None] | None


def write(report: LeagueReport, out: Path) -> None:
    """Write the page to `out` atomically. Raises StorageError."""
    with disk_errors(out, action="written"), replacing(out) as part:
        part.write_text(render_page(report), encoding="utf-8")


def render_page(report: LeagueReport) -> str:
    """The HTML document."""
    style, script = _asset("charts.css") + _asset("league.css"), _asset("flipbook.js")
    return (
        _templates()
        .get_template("league.html")
        .render(
            report=report,
            style=Markup(style),
            script=Markup(script),
            rules=_rules(style, script),
            ratings_chart=_ratings(report),
            listed_verdicts={verdict.verdict for verdict in report.verdicts},
            left_out=[*report.left_out, *_cut(report)],
            most_rows=MOST_ROWS,
        )
    )


@cache
def _asset(name: str) -> str:
    return (TEMPLATES / name).read_text(encoding="utf-8")


@cache
def _templates() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.globals["bar"] = charts.bar
    environment.filters |= {
        "alpha": _alpha,
        "bounds": _bounds,
        "cell": _cell,
        "cells": _cells,
        "confirmation": _confirmation,
        "difference": _difference,
        "elo": _elo,
        "evidence": _evidence,
        "exploitability": wording.exploitability,
        "interval": _interval,
        "margin_unit": wording.margin_unit,
        "timestamp": _timestamp,
        "outcome": _outcome,
        "percent": _percent,
        "plain": _plain,
        "players": _players,
        "score": _score,
        "short": _short,
        "span": _span,
        "signed": _signed,
        "summary": _summary,
        "short_verdict": short_verdict,
        "tone": _tone,
        "whisker": _whisker,
    }
    return environment


def _rules(style: str, script: str) -> str:
    """Content-Security-Policy of the page."""
    css, js = (b64encode(sha256(code.encode()).digest()).decode() for code in (style, script))
    return (
        f"default-src 'none'; style-src 'sha256-{css}'; script-src 'sha256-{js}'; img-src data:;"
        " base-uri 'none'; form-action 'none'"
    )


def _cut(report: LeagueReport) -> Iterator[str]:
    if len(report.leaderboard) > MOST_ROWS:
        yield f"Only the best {MOST_ROWS} of {len(report.leaderboard)} contestants are listed; --json contains all."
    if len(report.promotions) > MOST_ROWS:
        movements = len(report.promotions)
        yield f"Only the newest {MOST_ROWS} of {movements} changes of the champion are listed; --json contains all."


# Charts


def _ratings(report: LeagueReport) -> Markup | None:
    rated = [
        charts.RatingPoint(
            number=version.number,
            name=version.ref,
            rating=version.rating,
            interval=version.interval,
            was_champion=bool(version.champion_at),
            mark=f"@{version.number} champion" if version.ref == report.champion else None,
        )
        for version in report.versions
        if version.rating is not None
    ]
    if not rated:
        return None
    levels = [
        charts.RatingLevel(_short(standing.ref), standing.rating)
        for standing in report.leaderboard
        if standing.ref.startswith("script:") and standing.rating is not None
    ]
    first, last, best = rated[0], rated[-1], max(rated, key=lambda point: point.rating)
    label = (
        f"Ratings of {len(rated)} versions of {report.league} in Elo above {ANCHOR}: {_elo(first.rating)}"
        f" of {first.name}, {_elo(last.rating)} of {last.name}; the best is {best.name} at {_elo(best.rating)}"
    )
    return charts.ratings(rated, levels, label)


def _evidence(verdict: VerdictEvidence) -> Markup:
    lower, upper = verdict.bounds
    label = (
        f"Log likelihood ratio of {verdict.candidate} against {verdict.opponent}: {verdict.llr:+.2f} after"
        f" {verdict.blocks} blocks; the bounds are {lower:.2f} (reject) and {upper:.2f} (promote)"
    )
    return charts.evidence(verdict.curve, verdict.bounds, label)


def _span(row: Standing) -> str:
    return "anchor" if row.ref == ANCHOR else _interval(row.interval)


def _whisker(row: Standing, rows: Sequence[Standing]) -> Markup | str:
    if row.rating is None:
        return ""
    values = [
        value
        for standing in rows
        if standing.rating is not None
        for value in (standing.rating, *(standing.interval or ()))
    ]
    return charts.whisker(row.rating, row.interval, (min(values), max(values)))


# Words


def _elo(rating: float | None) -> str:
    return "–" if rating is None else charts.signed(rating)


def _interval(interval: Interval) -> str:
    """`[+98, +240]`; a bound of None is infinite."""
    if interval is None:
        return "–"
    low, high = interval
    return f"[{'−∞' if low is None else _elo(low)}, {'+∞' if high is None else _elo(high)}]"


def _bounds(bounds: Interval) -> str:
    return "–" if bounds is None else f"[{', '.join(_signed(bound) for bound in bounds)}]"


def _difference(gap: Difference) -> str:
    span = "" if gap.low is None or gap.high is None else f" [{_signed(gap.low)}, {_signed(gap.high)}]"
    return f"{_signed(gap.mean)}{span}"


def _signed(value: float | None) -> str:
    return "–" if value is None else "0" if value == 0 else _minus(f"{value:+.3g}")


def _plain(value: float | None) -> str:
    return "–" if value is None else _minus(f"{value:g}")


def _alpha(value: float) -> str:
    return _minus(f"{value:.2g}")


def _score(value: float) -> str:
    return f"{value:.3f}"


def _cell(score: float) -> str:
    """`.63`, or `1`"""
    return f"{score:.2f}".removesuffix(".00").replace("0.", ".") if 0 < score < 1 else f"{score:g}"


def _percent(share: float) -> str:
    return f"{share:.0%}"


def _minus(text: str) -> str:
    """With a minus sign as wide as a plus."""
    return text.replace("-", "−")


def _timestamp(text: str) -> str:
    return datetime.fromisoformat(text).strftime("%Y-%m-%d %H:%M UTC")


def _short(ref: str) -> str:
    """`@3` of a version, `one_ply` of a script."""
    return f"@{ref.rpartition('@')[2]}" if "@" in ref else ref.removeprefix("script:")


def _outcome(verdict: VerdictEvidence) -> str:
    if verdict.outcome == "promote":
        return "promoted" if verdict.promoted else "not promoted"
    return {"reject": "rejected", OPEN: "under way"}.get(verdict.outcome, verdict.outcome)


def _tone(verdict: VerdictEvidence) -> str:
    """Colour of the verdict's badge."""
    if verdict.outcome == "promote" and verdict.promoted:
        return "promote"
    return "reject" if verdict.outcome == "reject" else "other"


def _cells(verdict: VerdictEvidence) -> Sequence[str]:
    return CELLS[len(verdict.counts)]


def _confirmation(found: Confirmation) -> str:
    """`+31 Elo [+4, +59], score 0.544, 400 games`"""
    gap = f", returns differ by {_difference(found.difference)}" if found.difference else ""
    return f"{_elo(found.elo)} Elo {_interval(found.interval)}, score {_score(found.score)}, {found.games:,} games{gap}"


def _summary(game: Flipbook, scoring: Scoring) -> str:
    """`script:random won against connect_four@3`"""
    did = {"game": ("won against", "drew with"), "side": ("did better than", "did as well as")}[scoring]
    return f"{game.better} {did[0] if game.score > 0.5 else did[1]} {game.other}"


def _players(game: Flipbook) -> list[str]:
    """Players and returns by agent; with many agents, means by player."""
    crowds: dict[str, list[str]] = {}
    for agent, ref in game.players.items():
        crowds.setdefault(ref, []).append(agent)
    if len(game.players) <= 6:
        crowds = {agent: [agent] for agent in game.players}
    lines = []
    for crowd in crowds.values():
        mean = sum(game.returns[agent] for agent in crowd) / len(crowd)
        names = crowd[0] if len(crowd) == 1 else f"{crowd[0]} and {len(crowd) - 1} more"
        lines.append(f"{names}: {game.players[crowd[0]]}, return {_signed(mean)}")
    return lines
