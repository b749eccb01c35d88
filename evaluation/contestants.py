"""Who may take part in a league's matches: pinned versions, and the scripted baselines that can play its
environment.
"""

from __future__ import annotations

from league.errors import EnvironmentMismatch
from league.interface import Interface
from league.policies.scripted import script
from league.refs import CheckpointRef, ScriptRef, parse_ref
from league.registry.registry import Registry

ANCHOR = str(ScriptRef("random"))
"""The contestant whose rating is 0."""

BASELINES = (ANCHOR, str(ScriptRef("one_ply")))


def baselines(interface: Interface) -> list[str]:
    """The scripted baselines that can play these spaces."""
    return [ref for ref in BASELINES if _plays(ref, interface)]


def pinned(ref: str, league: str, registry: Registry) -> str:
    """A reference that means the same for ever: an alias becomes the version that it names now.

    Raises InvalidReference, UnknownVersion, UnknownAlias, UnknownPolicy for scripts that do not exist, and
    EnvironmentMismatch for versions of another league and scripts that cannot play this one.
    """
    parsed = parse_ref(ref)
    if isinstance(parsed, CheckpointRef):
        if parsed.league != league:
            raise EnvironmentMismatch(f"{ref} is not a version of league {league}")
        return registry.resolve(parsed).ref
    _check_plays(parsed, registry.league(league).interface)
    return ref


def _plays(ref: str, interface: Interface) -> bool:
    try:
        _check_plays(ScriptRef.parse(ref), interface)
    except EnvironmentMismatch:
        return False
    return True


def _check_plays(ref: ScriptRef, interface: Interface) -> None:
    for policy in interface.policy_ids:
        spaces = interface.of_policy(policy)
        script(ref.name, spaces.observation, spaces.action)
