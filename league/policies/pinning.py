"""References that mean the same for ever, of who can play in a league."""

from league.errors import EnvironmentMismatch
from league.interface import Interface
from league.policies.scripted import script
from league.refs import CheckpointRef, ScriptRef, parse_ref
from league.registry.registry import Registry


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
    check_plays(parsed, registry.league(league).interface)
    return ref


def check_plays(ref: ScriptRef, interface: Interface) -> None:
    """Raise UnknownPolicy if there is no such script, EnvironmentMismatch if it cannot play with these spaces."""
    for policy in interface.policy_ids:
        spaces = interface.of_policy(policy)
        script(ref.name, spaces.observation, spaces.action)
