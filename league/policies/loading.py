"""Loads policies by reference, and checks which versions and scripts may play in a league.

Only versions trained in the league's current environment take part in its matches. Versions of another environment
would be compared on a task that they were not trained for, even if the spaces are equal.
"""

from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import closing

from league.config.league import LeagueConfig
from league.config.ppo import PPOConfig
from league.errors import (
    ConfigError,
    EnvironmentMismatch,
    InvalidInput,
    LeagueError,
    UnknownAlias,
    UnknownLeague,
    UnknownPolicy,
    UnknownVersion,
)
from league.interface import Interface
from league.policies.onnx import OnnxPolicy
from league.policies.open_inference import fixed_version, remote_policies
from league.policies.policy import Policy
from league.policies.scripted import script
from league.refs import CHAMPION, CheckpointRef, RemoteRef, ScriptRef, of_league, parse_ref
from league.registry.registry import Registry
from league.registry.storage.manifest import MAIN, SEARCH
from league.registry.storage.rows import VersionRow

ANCHORS, OPPONENTS, TEACHER = "gate.anchors", "training.opponents", "training.teacher"
BASELINES = ("script:random", "script:one_ply")


def load(
    ref: str, policy: str | None = None, registry: Registry | None = None, *, episode: str | None = None
) -> Policy:
    """Load and verify a policy of a version: `load("connect_four@champion").act({"observation": …})`.

    Args:
        ref: The version, by number or alias.
        policy: The policy id; optional if the version has one policy.
        registry: The registry; by default the one configured by environment variables.
        episode: Name of the episode that the policy will play. For a mixture, selects the member, as `X-League-Key`
            does on the server.

    Raises:
        InvalidInput: The version is a mixture, and no episode is given.
        InvalidReference: The reference is malformed.
        UnknownLeague: The league does not exist.
        UnknownVersion: The version does not exist.
        UnknownAlias: The alias does not exist.
        UnknownPolicy: The policy does not exist, or is ambiguous.
        ArtifactCorrupt: A file differs from the manifest.
    """
    checkpoint = CheckpointRef.parse(ref)
    if registry is None:
        with closing(Registry.open()) as opened:
            return load(ref, policy, opened, episode=episode)
    version = registry.versions.resolve(checkpoint)
    if episode is not None:
        version = acting_version(version, registry, episode)
    return _policy(registry, version, policy)


def acting_version(version: VersionRow, registry: Registry, episode: str) -> VersionRow:
    """Return the version that plays an episode: the member of a mixture, or the version itself."""
    if version.mixture is None:
        return version
    return registry.versions.get(version.league, version.mixture.version_of(version.league, episode.encode()))


def acting_ref(ref: str, registry: Registry, episode: str) -> str:
    """Return the reference of the contestant that plays an episode: of a mixture, that of the member."""
    parsed = parse_ref(ref)
    if not isinstance(parsed, CheckpointRef):
        return ref
    return acting_version(registry.versions.resolve(parsed), registry, episode).ref


def players(ref: str, registry: Registry) -> dict[str, float]:
    """Return who plays the episodes of a fixed contestant, with probabilities: the members of a mixture, or itself."""
    parsed = parse_ref(ref)
    mixture = registry.versions.resolve(parsed).mixture if isinstance(parsed, CheckpointRef) else None
    if mixture is None or not isinstance(parsed, CheckpointRef):
        return {ref: 1.0}
    return {f"{parsed.league}@{member.version}": member.probability for member in mixture.members}


def contestant(ref: str, registry: Registry | None, interface: Interface) -> dict[str, tuple[str, Policy]]:
    """Load the policies of a contestant for all agents.

    Args:
        ref: A version, a script or a remote model.
        registry: The registry; required for versions.
        interface: Interface of the league.

    Returns:
        Policy id and policy of each agent. Agents with the same policy id share one object.

    Raises:
        EnvironmentMismatch: The version, script or remote model does not fit `interface`.
        RemoteError: The server of a remote model cannot be reached or failed.
        LeagueError: See `load`.
    """
    policies: Mapping[str, Policy]
    match parse_ref(ref):
        case ScriptRef() as parsed:
            spaces = {policy: interface.of_policy(policy) for policy in interface.policy_ids}
            policies = {
                policy: script(parsed.name, space.observation, space.action) for policy, space in spaces.items()
            }
        case RemoteRef() as parsed:
            policies = remote_policies(parsed, interface)
        case CheckpointRef() as parsed:
            policies = _version(parsed, registry, interface)
    return {agent: (interface.policies[agent], policies[interface.policies[agent]]) for agent in interface.agents}


def _version(ref: CheckpointRef, registry: Registry | None, interface: Interface) -> dict[str, Policy]:
    if registry is None:
        raise InvalidInput(f"{ref} is a version: without a registry, only scripts and remote models can be loaded")
    version = registry.versions.resolve(ref)
    if version.manifest.interface.digest() != interface.digest():
        raise EnvironmentMismatch(f"the spaces or policies of {version.ref} differ from those of the environment")
    return {policy: _policy(registry, version, policy) for policy in interface.policy_ids}


def _policy(registry: Registry, version: VersionRow, policy: str | None) -> Policy:
    version.require_policies()
    manifest = version.manifest.policies[policy_id(version, policy)]
    graph = registry.artifacts.read(version.manifest, manifest.file)
    return OnnxPolicy(graph, manifest, version.manifest.has_distribution)


def policy_id(version: VersionRow, policy: str | None) -> str:
    """Return the id of a policy of a version; None selects the only one. Raises UnknownPolicy."""
    ids = version.manifest.interface.policy_ids
    if policy is None and len(ids) == 1:
        return ids[0]
    if policy not in ids:
        problem = (
            f"{version.ref} has no policy {policy!r}" if policy else f"{version.ref} has several policies: specify one"
        )
        raise UnknownPolicy(f"{problem}; known: {', '.join(ids)}")
    return policy


def pinned(ref: str, league: str, registry: Registry) -> str:
    """Return an immutable reference: an alias is replaced by its current version, and the URL of a remote model by that
    of the version that answers now. Bots are not imported.

    Raises:
        InvalidReference: The reference is malformed.
        UnknownVersion: The version does not exist.
        UnknownAlias: The alias does not exist.
        UnknownPolicy: The script does not exist.
        EnvironmentMismatch: The version belongs to another league, or the script or remote model does not support the
            spaces.
        RemoteError: The server of a remote model cannot be reached or failed.
    """
    parsed = parse_ref(ref)
    if isinstance(parsed, CheckpointRef):
        _check_league(parsed, league)
        return registry.versions.resolve(parsed).ref
    row = registry.leagues.get(league)
    if isinstance(parsed, RemoteRef):
        return str(fixed_version(parsed, row.interface))
    if not parsed.is_bot:
        check_plays(parsed, row.interface)
    return ref


def requested(ref: str, league: str, registry: Registry) -> str:
    """Return the reference of a contestant that a request over the network names, with aliases replaced by versions.

    A request must not choose which code is imported or which servers are called: bots and remote models must be named
    by the league's configuration. They are neither imported nor called here.

    Raises:
        UnknownPolicy: The script does not exist, or the configuration does not name the bot or the remote model.
        LeagueError: See `pinned` and `check_eligible`.
    """
    config = registry.leagues.get(league).config
    if _is_remote(ref):
        remotes = [RemoteRef.parse(named).default for named in configured_contestants(config) if _is_remote(named)]
        if RemoteRef.parse(ref).default not in remotes:
            raise _not_configured(ref, config, "remote models", [str(remote) for remote in remotes])
        return ref
    fixed = pinned(ref, league, registry)
    if _is_bot(fixed) and fixed not in (bots := [bot for bot in configured_contestants(config) if _is_bot(bot)]):
        raise _not_configured(fixed, config, "bots", bots)
    check_eligible(fixed, registry, config)
    return fixed


def _not_configured(ref: str, config: LeagueConfig, kind: str, known: list[str]) -> UnknownPolicy:
    return UnknownPolicy(
        f"{ref} is neither in gate.anchors nor in training.opponents of {config.league};"
        f" its {kind}: {', '.join(known) or 'none'}"
    )


def check_contestants(config: LeagueConfig, interface: Interface | None, registry: Registry) -> None:
    """Check the scripts, bots and remote models that a configuration names, and the versions among its anchors.

    Versions among the opponents are checked when training resolves them. interface: of the league; None to check
    versions only.

    Raises:
        ConfigError: One does not exist, cannot be imported or reached, or cannot play in this league. Names its key.
    """
    for fault in faults_of_contestants(config, interface, lambda: registry, of_versions=(ANCHORS,)):
        raise fault


def faults_of_contestants(
    config: LeagueConfig,
    interface: Interface | None,
    open_registry: Callable[[], Registry],
    of_versions: Collection[str] = (ANCHORS, OPPONENTS, TEACHER),
) -> Iterator[ConfigError]:
    """Yield what is wrong with the contestants that a configuration names. See `check_contestants`.

    The registry is opened if a version is named. of_versions: keys below which versions are checked, too.
    """
    named = [(ANCHORS, anchor.ref) for anchor in config.gate.anchors]
    named += [(OPPONENTS, opponent.ref) for opponent in config.training.opponents.fixed]
    if isinstance(config.training, PPOConfig) and config.training.teacher is not None:
        named.append((TEACHER, config.training.teacher.ref))
    for key, ref in named:
        try:
            parsed = parse_ref(of_league(ref, config.league))
            if not isinstance(parsed, CheckpointRef):
                if interface is not None:
                    check_plays(parsed, interface)
            elif key in of_versions:
                _check_version(parsed, config, open_registry())
        except LeagueError as error:
            fault = ConfigError(f"{key}: {error}")
            fault.__cause__ = error
            yield fault


def _check_version(ref: CheckpointRef, config: LeagueConfig, registry: Registry) -> None:
    """Raise NotFound or EnvironmentMismatch unless the version exists and can play in the league.

    The alias of the champion may not exist yet, nor may any alias of a league without versions.
    """
    _check_league(ref, config.league)
    try:
        registry.versions.resolve(ref)
    except UnknownAlias:
        if ref.version == CHAMPION or not registry.versions.all(config.league):
            return
        raise
    except UnknownLeague as error:
        if isinstance(ref.version, str):
            return
        raise UnknownVersion(f"league {config.league} has no version yet: train it first") from error
    check_eligible(str(ref), registry, config)


def configured_contestants(config: LeagueConfig) -> list[str]:
    """Return the bots and remote models among the anchors and opponents of a configuration."""
    return [ref for ref in _anchors_and_opponents(config) if _is_bot(ref) or _is_remote(ref)]


def configured_scripts(config: LeagueConfig, interface: Interface) -> list[str]:
    """Return the scripts among the anchors and opponents of a configuration that can play, except bots."""
    scripts = (ref for ref in _anchors_and_opponents(config) if ref.startswith("script:") and not _is_bot(ref))
    return [ref for ref in scripts if _plays(ref, interface)]


def _anchors_and_opponents(config: LeagueConfig) -> list[str]:
    named = [anchor.ref for anchor in config.gate.anchors] + [
        opponent.ref for opponent in config.training.opponents.fixed
    ]
    return list(dict.fromkeys(named))


def baselines(config: LeagueConfig, interface: Interface) -> list[str]:
    """Return the scripted baselines that can play a league, and the bots and remote models that its configuration
    names.
    """
    return [*(ref for ref in BASELINES if _plays(ref, interface)), *configured_contestants(config)]


def _plays(ref: str, interface: Interface) -> bool:
    try:
        check_plays(ScriptRef.parse(ref), interface)
    except (ConfigError, EnvironmentMismatch, UnknownPolicy):
        return False
    return True


def _is_remote(ref: str) -> bool:
    return ref.startswith(("http://", "https://"))


def _is_bot(ref: str) -> bool:
    return ref.startswith("script:") and ScriptRef.parse(ref).is_bot


def check_plays(ref: ScriptRef | RemoteRef, interface: Interface) -> None:
    """Raise UnknownPolicy if the script does not exist, EnvironmentMismatch if it does not support the spaces.

    Imports bots, and raises ConfigError if that fails. Calls remote models, and raises RemoteError if that fails.
    """
    if isinstance(ref, RemoteRef):
        fixed_version(ref, interface)
        return
    for policy in interface.policy_ids:
        spaces = interface.of_policy(policy)
        script(ref.name, spaces.observation, spaces.action)


def eligible(registry: Registry, league: str) -> list[VersionRow]:
    """Return the versions of the league's current environment, except retired ones, exploiters and mixtures.

    Raises UnknownLeague.
    """
    digest = registry.leagues.get(league).config.environment.digest()
    present = (version for version in registry.versions.all(league) if version.retired_at is None)
    return [
        version
        for version in present
        if version.role in (MAIN, SEARCH) and version.manifest.environment_digest == digest
    ]


def strength_opponents(
    config: LeagueConfig, registry: Registry, *, version: str | None = None, most_anchors: int | None = None
) -> list[str]:
    """Return whom the strength of policies in training is measured against, as fixed references.

    Args:
        config: The league.
        registry: The registry.
        version: The version that plays, which is not its own opponent.
        most_anchors: Maximum number of anchors; None for all.

    Returns:
        The champion, if there is one, and the anchors of the gate that can play, otherwise `script:random`.
    """

    def opponent(ref: str) -> str | None:
        try:
            fixed = pinned(of_league(ref, config.league), config.league, registry)
            check_eligible(fixed, registry, config)
        except (UnknownAlias, EnvironmentMismatch):
            return None
        return None if fixed == version else fixed

    champion = opponent(f"@{CHAMPION}")
    pinned_anchors = dict.fromkeys(opponent(anchor.ref) for anchor in config.gate.anchors)
    anchors = [ref for ref in pinned_anchors if ref not in (None, champion)][:most_anchors]
    return [ref for ref in (champion, *(anchors or BASELINES[:1])) if ref is not None]


def check_eligible(ref: str, registry: Registry, config: LeagueConfig) -> None:
    """Raise EnvironmentMismatch if `ref` is a version of another league or was trained in another environment.

    Also raises UnknownVersion, UnknownAlias and UnknownLeague.
    """
    parsed = parse_ref(ref)
    if not isinstance(parsed, CheckpointRef):
        return
    _check_league(parsed, config.league)
    manifest, environment = registry.versions.resolve(parsed).manifest, config.environment
    if manifest.environment_digest == environment.digest():
        return
    trained_fields, current_fields = (
        environment_config.model_dump(mode="json", by_alias=True)
        for environment_config in (manifest.environment, environment)
    )
    differences = [
        f"{name} {trained_fields[name]!r} instead of {current_fields[name]!r}"
        for name in trained_fields
        if trained_fields[name] != current_fields[name]
    ]
    raise EnvironmentMismatch(
        f"{ref} was trained in another environment ({manifest.environment_digest[:12]}) than {config.league} has now"
        f" ({environment.digest()[:12]}), with {', '.join(differences)}: it cannot play in matches of this league"
    )


def _check_league(ref: CheckpointRef, league: str) -> None:
    if ref.league != league:
        raise EnvironmentMismatch(f"{ref} is not a version of league {league}")
