"""Which version a run may continue from: it must fit the league and the network of the configuration."""

from pydantic import TypeAdapter, ValidationError

from league.config.algorithms import ALGORITHMS, TrainingConfig
from league.config.league import LeagueConfig
from league.errors import ConfigError, InterfaceChanged
from league.interface import Interface
from league.refs import CheckpointRef
from league.registry.registry import Registry
from league.registry.storage.rows import VersionRow
from training.algorithms.rllib_config import algorithm_class

NETWORK_SETTINGS = (
    *("convolutions", "channels", "hidden", "network", "recurrence", "normalize_observations"),
    *("shared_encoder", "dueling", "noisy", "distributional"),
    *("mixer", "mixing_width", "groups", "critic"),
)
"""Settings that define the network: a version's weights require the same values."""


def parent_version(registry: Registry, ref: CheckpointRef, config: LeagueConfig, interface: Interface) -> VersionRow:
    """Return the version to continue from, which must fit the league and its network."""
    if ref.league != config.league:
        raise ConfigError(f"--from: {ref} belongs to another league than {config.league}")
    version = registry.versions.resolve(ref)
    if version.mixture is not None:
        raise ConfigError(f"--from: {version.ref} is a mixture ({version.mixture}): start from one of its members")
    if version.search is not None:
        raise ConfigError(f"--from: {version.ref} searches ({version.search}): start from @{version.search.version}")
    if version.manifest.interface.digest() != interface.digest():
        raise InterfaceChanged(f"{version.ref} has other spaces or policies than the environment now")
    check_network(version, config)
    return version


def start_version(
    registry: Registry, parent: CheckpointRef, config: LeagueConfig, target: CheckpointRef | None
) -> CheckpointRef | None:
    """Return the version that a run of a night or a gate starts from, None for one that starts from scratch.

    An exploiter starts from `parent` or from scratch: if that was imported, has another network than `config` defines,
    or its training state was removed. The training of a night starts from `parent`, or if that was imported, from the
    newest version of its league that can be trained further. In place of a search version, what it plays counts.

    Args:
        registry: The registry of the league.
        parent: The version that it continues if that can be trained further.
        config: The settings of the run.
        target: The version that an exploiter is trained against.
    """
    version = registry.versions.resolve(parent)
    if version.search is not None:
        parent = CheckpointRef(parent.league, version.search.version)
        version = registry.versions.resolve(parent)
    if target is not None:
        try:
            check_network(version, config.against(version.ref))
        except ConfigError:
            return None
        return parent if registry.versions.has_training(version) else None
    if _is_trained(version):
        return parent
    for other in reversed(registry.versions.all(parent.league)):
        trained = other.exploits is None and _is_trained(other)
        if trained and registry.versions.has_training(other):
            return CheckpointRef(other.league, other.number)
    return None


def check_network(version: VersionRow, config: LeagueConfig) -> None:
    """Raise ConfigError if `config` defines another network than the version. Missing settings have defaults."""
    if not _is_trained(version):
        raise ConfigError(f"{version.ref} was {version.manifest.algorithm}: it has no training state to start from")
    try:
        settings: TrainingConfig = TypeAdapter(TrainingConfig).validate_python(version.manifest.settings)
    except ValidationError as error:
        raise ConfigError(f"{version.ref} was trained with settings of another release") from error
    if not _have_equal_networks(settings.algorithm, config.training.algorithm):
        raise ConfigError(
            f"training.algorithm: {version.ref} was trained with {settings.algorithm}, got {config.training.algorithm}"
        )
    old_settings, new_settings = (part.model_dump(mode="json", by_alias=True) for part in (settings, config.training))
    for key in NETWORK_SETTINGS:
        # Each algorithm has a subset of them.
        if key in old_settings and key in new_settings and old_settings[key] != new_settings[key]:
            raise ConfigError(
                f"training.{key}: {version.ref} was trained with {old_settings[key]}, got {new_settings[key]}"
            )


def _have_equal_networks(old: str, new: str) -> bool:
    """Return whether one algorithm can continue what the other one has trained, because it is derived from it."""
    if old == new:
        return True
    first, second = algorithm_class(old), algorithm_class(new)
    return (issubclass(first, second) or issubclass(second, first)) and first.module_class is second.module_class


def _is_trained(version: VersionRow) -> bool:
    """Return whether a version is neither imported nor a mixture."""
    return version.manifest.algorithm in ALGORITHMS or ":" in version.manifest.algorithm
