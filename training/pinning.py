"""Who plays against the learners: references as the user wrote them → what they meant when training began."""

from league.config import LeagueConfig
from league.interface import Interface
from league.policies.loading import contestant
from league.refs import CheckpointRef, of_league, parse_ref
from league.registry.registry import Registry


def pin(config: LeagueConfig, registry: Registry, interface: Interface) -> dict[str, str]:
    """What each opponent of `training.opponents` is now: reference as written → `script:name` or `league@number`.

    Raises what loading it raises: a version, alias or script that does not exist, or does not fit the league.
    """
    pins = {}
    for opponent in config.training.opponents:
        ref = parse_ref(of_league(opponent.ref, config.league))
        pinned = registry.resolve(ref).ref if isinstance(ref, CheckpointRef) else str(ref)
        contestant(pinned, registry, interface)
        pins[opponent.ref] = pinned
    return pins


def with_pins(config: LeagueConfig, pins: dict[str, str]) -> LeagueConfig:
    """The league with its opponents named by what they are pinned to; those that are not pinned stay."""
    opponents = [
        opponent.model_dump() | {"ref": pins.get(opponent.ref, opponent.ref)} for opponent in config.training.opponents
    ]
    return config.with_training(opponents=opponents)
