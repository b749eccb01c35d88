"""How often does one verdict change from module to module, from `league nightly` to the promotion?

The league is fixed: a candidate that passes the tests against the champion, two anchors and an exploiter. The command
runs in this process, without Ray. A profiler sees its calls and returns until the verdict is closed and printed.

Counted are changes between modules of the project in the trace of calls. A loop counts once: of the calls that one
activation of a function makes from one place to one function, only the first is followed. Playing the games is not part
of a verdict, and neither is what the kernel (`league`) does within itself: a call into it is one change there and one
back. Imports are not calls.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from types import CodeType, FrameType
from typing import Annotated, Any

import typer

from benchmarks.harness import ROOT, Quick, Target
from league.config.league import LeagueConfig
from league.registry.registry import Registry
from policy_league.cli.evaluation.nightly import run_night
from tests.support.leagues import tictactoe
from tests.support.leagues.judged_league import MIDDLING, STRONG, STRONGEST, league_of

BEFORE = 579
"""Changes before the tests of a verdict had one module per kind."""
PACKAGES = ("evaluation", "league", "policy_league")
HIDDEN = ("evaluation.matches.", "evaluation.playback.", "evaluation.schedules.")
"""Modules that play. Only calls into them from elsewhere are seen, and their calls of the listener and the monitor."""
CONFIG = tictactoe.config(
    play={"opening_plies": 2, "num_envs": 4},
    gate={
        "elo1": 150,
        "max_blocks": 200,
        "anchors": ["script:one_ply", {"ref": "script:random", "mode": "at_least"}],
        "margin": 100,
        "exploiter_margin": 0.5,
        "confirmation_blocks": 4,
    },
)


class Trace:
    """The modules in which the calls and returns of a profiled program take place, in order."""

    def __init__(self) -> None:
        self.modules: list[str] = []
        self._stack: list[tuple[FrameType, str]] = []
        self._made: dict[FrameType, set[tuple[int, CodeType, int]]] = {}
        self._skipped: FrameType | None = None

    def __call__(self, frame: FrameType, event: str, _: Any) -> None:
        if event == "return":
            self._leave(frame)
        elif event == "call" and self._skipped is None:
            self._enter(frame)

    def _enter(self, frame: FrameType) -> None:
        if (module := _module(frame.f_code)) is None:
            return
        if self._stack:
            caller, origin = self._stack[-1]
            if _is_internal(origin, module):
                return
            call = (caller.f_lasti, frame.f_code, frame.f_lasti)
            if call in self._made.setdefault(caller, set()) or frame.f_code.co_name == "<module>":
                self._skipped = frame
                return
            self._made[caller].add(call)
        self._stack.append((frame, module))
        self.modules.append(module)

    def _leave(self, frame: FrameType) -> None:
        if frame is self._skipped:
            self._skipped = None
        elif self._skipped is None and self._stack and self._stack[-1][0] is frame:
            self._stack.pop()
            if self._stack:
                self.modules.append(self._stack[-1][1])

    @property
    def stays(self) -> list[str]:
        """The modules, each once per stay."""
        return self.modules[:1] + [module for before, module in pairwise(self.modules) if module != before]


def _module(code: CodeType) -> str | None:
    path = Path(code.co_filename)
    if not path.is_relative_to(ROOT) or path.relative_to(ROOT).parts[0] not in PACKAGES:
        return None
    return ".".join(path.relative_to(ROOT).with_suffix("").parts)


def _is_internal(origin: str, module: str) -> bool:
    """Whether a call stays within the kernel or within what plays."""
    is_kernel = origin.startswith("league.") and module.startswith("league.")
    return is_kernel or (origin.startswith(HIDDEN) and module.startswith((*HIDDEN, "league.")))


def league(home: Path) -> Registry:
    """A league with a champion, an exploiter of it, and a candidate."""
    registry = league_of(home, MIDDLING, config=CONFIG)
    registry.aliases.set(CONFIG.league, "champion", 1, expected=None, actor="me", reason="first")
    tictactoe.publish(registry, STRONGEST, exploits="tictactoe@1")
    tictactoe.publish(registry, STRONG)
    return registry


def traced(config: LeagueConfig) -> Trace:
    """The trace of `league nightly` on a league with one candidate, until its verdict is closed and printed."""
    trace = Trace()

    def until_confirmation(frame: FrameType, event: str, argument: Any) -> None:
        if frame.f_code.co_name == "confirm" and event == "call":
            sys.setprofile(None)
            return
        trace(frame, event, argument)

    sys.setprofile(until_confirmation)
    try:
        run_night(config, workers=0)
    finally:
        sys.setprofile(None)
    return trace


def main(
    trace: Annotated[bool, typer.Option("--trace", help="also print the modules in order")] = False,
    quick: Quick = False,  # noqa: ARG001  it is as short as it can be
) -> Iterator[Target]:
    """The number of changes, and the stays in each module."""
    with tempfile.TemporaryDirectory() as home:
        os.environ["LEAGUE_HOME"] = home
        registry = league(Path(home))
        stays = traced(CONFIG).stays
        (verdict,) = registry.verdicts.all(CONFIG.league)
        assert verdict.outcome == "promote", verdict.evidence
        registry.close()
    if trace:
        print("\n".join(stays))
    for module, number in Counter(stays).most_common():
        print(f"{number:6} {module}")
    note = f"between {len(set(stays))} modules; {BEFORE} before one module per kind of test"
    yield Target("changes of module of one verdict", len(stays) - 1, at_most=0.6 * BEFORE, note=note)
