"""The scripted baselines that take part in a league's matches."""

from __future__ import annotations

from league.errors import EnvironmentMismatch
from league.interface import Interface
from league.policies.pinning import check_plays
from league.refs import ScriptRef

ANCHOR = str(ScriptRef("random"))
"""The contestant whose rating is 0."""

BASELINES = (ANCHOR, str(ScriptRef("one_ply")))


def baselines(interface: Interface) -> list[str]:
    """The scripted baselines that can play these spaces."""
    return [ref for ref in BASELINES if _plays(ref, interface)]


def _plays(ref: str, interface: Interface) -> bool:
    try:
        check_plays(ScriptRef.parse(ref), interface)
    except EnvironmentMismatch:
        return False
    return True
