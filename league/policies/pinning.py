"""References that mean the same for ever, of who may take part in a league's matches: scripts that can play it, and
versions that were trained in the environment which the league has now.

A version of another environment, though the spaces be the same, would be compared with others at a task that only they
have learned; and its ratings would be no measure of what it does where it is used.
"""

from league.config import LeagueConfig
from league.errors import EnvironmentMismatch
from league.interface import Interface
from league.policies.scripted import script
from league.refs import CheckpointRef, ScriptRef, parse_ref
from league.registry.registry import Registry
from league.registry.rows import VersionRow


def pinned(ref: str, league: str, registry: Registry) -> str:
    """A reference that means the same for ever: an alias becomes the version that it names now.

    Raises InvalidReference, UnknownVersion, UnknownAlias, UnknownPolicy for scripts that do not exist, and
    EnvironmentMismatch for versions of another league and scripts that cannot play this one.
    """
    parsed = parse_ref(ref)
    if isinstance(parsed, CheckpointRef):
        _check_league(parsed, league)
        return registry.resolve(parsed).ref
    check_plays(parsed, registry.league(league).interface)
    return ref


def check_plays(ref: ScriptRef, interface: Interface) -> None:
    """Raise UnknownPolicy if there is no such script, EnvironmentMismatch if it cannot play with these spaces."""
    for policy in interface.policy_ids:
        spaces = interface.of_policy(policy)
        script(ref.name, spaces.observation, spaces.action)


def eligible(registry: Registry, league: str) -> list[VersionRow]:
    """The versions of a league that may take part in its matches. Raises UnknownLeague."""
    now = registry.league(league).config.environment.digest()
    return [version for version in registry.versions(league) if version.manifest.environment_digest == now]


def check_eligible(ref: str, registry: Registry, config: LeagueConfig) -> None:
    """Raise EnvironmentMismatch if `ref` is a version of another league or, saying what differs, one that was trained
    in another environment.

    Raises UnknownVersion, UnknownAlias and UnknownLeague, too.
    """
    parsed = parse_ref(ref)
    if not isinstance(parsed, CheckpointRef):
        return
    _check_league(parsed, config.league)
    manifest, now = registry.resolve(parsed).manifest, config.environment
    if manifest.environment_digest == now.digest():
        return
    own, other = (each.model_dump(mode="json", by_alias=True) for each in (manifest.environment, now))
    differences = [f"{name} {own[name]!r} instead of {other[name]!r}" for name in own if own[name] != other[name]]
    raise EnvironmentMismatch(
        f"{ref} was trained in another environment ({manifest.environment_digest[:12]}) than {config.league} has now"
        f" ({now.digest()[:12]}), with {', '.join(differences)}: it takes no part in its matches"
    )


def _check_league(ref: CheckpointRef, league: str) -> None:
    if ref.league != league:
        raise EnvironmentMismatch(f"{ref} is not a version of league {league}")
