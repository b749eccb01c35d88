"""From a reference to something that acts."""

from league.errors import EnvironmentMismatch, InvalidInput, UnknownPolicy
from league.interface import Interface
from league.policies.onnx import OnnxPolicy
from league.policies.policy import Policy
from league.policies.scripted import script
from league.refs import CheckpointRef, ScriptRef, parse_ref
from league.registry.registry import Registry
from league.registry.rows import VersionRow


def load(ref: str, policy: str | None = None, registry: Registry | None = None) -> Policy:
    """Load one policy of a version, verified: `load("connect_four@champion").act({"observation": …})`.

    policy: which one, needed only where the version has several.
    registry: where to look; by default the one that LEAGUE_HOME and its siblings name.
    Raises InvalidReference, UnknownLeague, UnknownVersion, UnknownAlias, UnknownPolicy or ArtifactCorrupt.
    """
    checkpoint = CheckpointRef.parse(ref)
    if registry is not None:
        return _policy(registry, registry.resolve(checkpoint), policy)
    registry = Registry.open()
    try:
        return _policy(registry, registry.resolve(checkpoint), policy)
    finally:
        registry.close()


def contestant(ref: str, registry: Registry | None, interface: Interface) -> dict[str, tuple[str, Policy]]:
    """Who acts for each agent: agent → (policy id, policy). Agents of one policy id share one object.

    registry: where versions are; not needed for a script.
    Raises what `load` does, and EnvironmentMismatch if the version or script does not fit `interface`.
    """
    parsed = parse_ref(ref)
    policies = _script(parsed, interface) if isinstance(parsed, ScriptRef) else _version(parsed, registry, interface)
    return {agent: (interface.policies[agent], policies[interface.policies[agent]]) for agent in interface.agents}


def _script(ref: ScriptRef, interface: Interface) -> dict[str, Policy]:
    spaces = {policy: interface.of_policy(policy) for policy in interface.policy_ids}
    return {policy: script(ref.name, space.observation, space.action) for policy, space in spaces.items()}


def _version(ref: CheckpointRef, registry: Registry | None, interface: Interface) -> dict[str, Policy]:
    if registry is None:
        raise InvalidInput(f"{ref} is a version: without a registry, only scripts can be loaded")
    version = registry.resolve(ref)
    if version.manifest.interface.digest() != interface.digest():
        raise EnvironmentMismatch(f"{version.ref} has other spaces or policies than the environment that it is to play")
    return {policy: _policy(registry, version, policy) for policy in interface.policy_ids}


def _policy(registry: Registry, version: VersionRow, policy: str | None) -> Policy:
    known = version.manifest.policies
    if policy is None and len(known) == 1:
        policy = next(iter(known))
    if policy not in known:
        asked = f"{version.ref} has no policy {policy!r}" if policy else f"{version.ref} has several policies: name one"
        raise UnknownPolicy(f"{asked}; known: {', '.join(known)}")
    manifest = known[policy]
    return OnnxPolicy(registry.artifacts.read(version.manifest, manifest.file), manifest)
