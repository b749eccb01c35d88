"""Games as they are played: a live bar in a terminal; elsewhere, and for verdicts, plain lines."""

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from cli.output import console
from evaluation.report import Difference, Listener, VerdictReport
from evaluation.report import Progress as Games


class watched:  # noqa: N801  reads as a phrase where it is used
    """`with watched(quiet) as listener:` tells of games and verdicts while they go on, unless it is to be quiet."""

    def __init__(self, quiet: bool) -> None:
        self._quiet = quiet
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=quiet or not console.is_terminal,
        )
        self._task = self._bar.add_task("", total=None, note="")

    def __enter__(self) -> Listener:
        self._bar.start()
        return self._tell

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def _tell(self, event: Games | VerdictReport) -> None:
        if self._quiet:
            return
        if isinstance(event, VerdictReport):
            console.print(f"  {verdict(event)}", markup=False, soft_wrap=True)
            return
        note = "" if event.llr is None else f"LLR {event.llr:+.2f}"
        self._bar.update(self._task, description=event.what, completed=event.played, total=event.of, note=note)


def verdict(report: VerdictReport) -> str:
    """`connect_four@2 against connect_four@1: promote after 40 games (40 different), score 0.710, LLR +2.97 in […]`"""
    score = "–" if report.score is None else f"{report.score:.3f}"
    low, high = report.bounds
    games = f"after {report.games} games ({report.distinct_games} different), score {score}"
    place = f"LLR {report.llr:+.2f} in [{low:+.2f}, {high:+.2f}]"
    gap = f", returns differ by {difference(report.difference)}" if report.difference else ""
    anchors = "".join(
        f"; {each.outcome} to {each.ref} by {each.margin:g} after {each.games} games" for each in report.anchors
    )
    note = f": {report.note}" if report.note else ""
    return f"{report.candidate} against {report.opponent}: {report.outcome} {games}, {place}{gap}{anchors}{note}"


def difference(gap: Difference) -> str:
    """`+1.5 [0.9, 2.1]`"""
    span = "" if gap.low is None or gap.high is None else f" [{gap.low:.4g}, {gap.high:.4g}]"
    return f"{gap.mean:+.4g}{span}"
