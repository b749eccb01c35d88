"""From a verdict to the alias: a compare-and-set of `champion` against the champion that was tested."""

from __future__ import annotations

from league.errors import AliasMoved
from league.refs import CHAMPION, CheckpointRef, ScriptRef, parse_ref
from league.registry.registry import Registry
from league.registry.rows import VerdictRow

ACTOR = "league nightly"


def is_applied(registry: Registry, verdict: VerdictRow) -> bool:
    """Whether the champion was moved on this verdict, whatever became of it since."""
    return any(event.verdict == verdict.id for event in registry.history(verdict.league))


def tested_champion(verdict: VerdictRow) -> int | None:
    """The champion that the challenger was held against; None if there was none and a script stood in."""
    match parse_ref(verdict.champion):
        case CheckpointRef(version=int(number)):
            return number
        case ScriptRef():
            return None
    raise AssertionError(f"verdict {verdict.id} names {verdict.champion}, which is not pinned")


def apply(registry: Registry, verdict: VerdictRow, reason: str) -> str | None:
    """Make the verdict's challenger champion, once; returns None, or the sentence that says why it was refused.

    It is refused if the champion is no longer the one that the challenger was tested against: a test against one
    champion says nothing about another. Applying a verdict again changes nothing.
    """
    if is_applied(registry, verdict):
        return None
    try:
        registry.set_alias(
            verdict.league,
            CHAMPION,
            verdict.candidate,
            expected=tested_champion(verdict),
            actor=ACTOR,
            reason=reason,
            verdict=verdict.id,
        )
    except AliasMoved as error:
        return str(error)
    return None
