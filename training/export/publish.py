"""Publishes a training checkpoint as a version in the registry."""

import pickle
import shutil
import subprocess
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from ray.rllib.core import COMPONENT_LEARNER, COMPONENT_LEARNER_GROUP, COMPONENT_RL_MODULE

from league.config.league import LeagueConfig
from league.config.ppo import PPOConfig
from league.interface import Interface
from league.policies.onnx import OnnxPolicy
from league.registry.registry import Registry
from league.registry.storage.manifest import PROBES, TRAINING, VALUE, Manifest, PolicyManifest, trained_role
from league.registry.storage.rows import VersionRow
from league.stack import installed
from training.algorithms.rllib_config import module_spec
from training.export import parity
from training.export.onnx_export import export_policy, graph_tensors
from training.learners.ppo import SCALES
from training.modules.actor_critic import ActorCritic
from training.modules.policy_module import PolicyModule
from training.modules.value_function import ReturnNormalization

MODULES = Path(COMPONENT_LEARNER_GROUP, COMPONENT_LEARNER, COMPONENT_RL_MODULE)
"""Where an Algorithm's checkpoint stores the modules."""


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """RLlib's state on disk.

    source: its unique name, "<run>/<steps>". steps: actions of training, including parents'.
    """

    path: Path
    source: str
    steps: int


def publish(
    checkpoint: Checkpoint,
    *,
    registry: Registry,
    config: LeagueConfig,
    interface: Interface,
    parent: int | None,
    exploits: str | None = None,
    git_commit: str | None,
) -> VersionRow:
    """Export the policies of `checkpoint`, check parity, and publish the graphs with the training state.

    exploits: the version that an exploiter was trained against; None for other versions.
    Raises ParityError, or an error of `VersionPublisher.publish`; nothing is published in that case.
    """

    def build(staging: Path, number: int) -> Manifest:
        shutil.copytree(checkpoint.path, staging / TRAINING)
        return export(
            checkpoint,
            staging,
            number,
            config=config,
            interface=interface,
            parent=parent,
            exploits=exploits,
            git_commit=git_commit,
        )

    return registry.publisher.publish(config.league, build, source=checkpoint.source, parent=parent)


def export(
    checkpoint: Checkpoint,
    directory: Path,
    number: int,
    *,
    config: LeagueConfig,
    interface: Interface,
    parent: int | None = None,
    exploits: str | None = None,
    git_commit: str | None = None,
) -> Manifest:
    """Write graphs and probes of the policies of `checkpoint` to `directory`, check parity, and return the manifest.

    number: of the version. parent, exploits, git_commit: see `publish`. Raises ParityError.
    """
    modules = load_modules(checkpoint.path, config, interface)
    observations = parity.collect_observations(config.environment, interface, modules, seed=config.training.seed)
    scales = load_scales(checkpoint.path, config)
    policies = {}
    for policy, module in modules.items():
        spaces, file, probes = interface.of_policy(policy), f"{policy}.onnx", f"{policy}{PROBES}"
        # Values can be exported if they depend on one observation only.
        is_own = isinstance(config.training, PPOConfig) and config.training.critic == "own"
        critic = module if is_own and isinstance(module, ActorCritic) and module.recurrent is None else None
        scale = scales.get(policy)
        value = None if critic is None else f"{policy}{VALUE}"
        export_policy(module, spaces, directory / file, None if value is None else directory / value, scale)
        inputs, outputs, state = graph_tensors(module, spaces)
        graph = OnnxPolicy(directory / file)
        parity.check_rows(policy, graph, observations[policy], spaces.action)
        proof = parity.check_parity(directory / file, policy, module, observations[policy], spaces.action)
        policy_probes = parity.probes(graph, observations[policy])
        (directory / probes).write_bytes(policy_probes.to_bytes())
        if critic is not None and value is not None:
            parity.check_value(directory / value, policy, critic, scale, observations[policy])
        policies[policy] = PolicyManifest(
            file=file,
            observation=spaces.observation,
            action=spaces.action,
            inputs=inputs,
            outputs=outputs,
            state=state,
            parity=proof,
            probes=probes,
            value=value,
        )
    return Manifest(
        league=config.league,
        version=number,
        created_at=datetime.now(UTC),
        interface=interface,
        policies=policies,
        environment=config.environment,
        environment_digest=config.environment.digest(),
        algorithm=config.training.algorithm,
        settings=config.training.model_dump(mode="json", by_alias=True),
        seed=config.training.seed,
        steps=checkpoint.steps,
        parent=parent,
        role=trained_role(exploits),
        exploits=exploits,
        git_commit=git_commit,
        stack=installed(),
    )


def load_modules(checkpoint: Path, config: LeagueConfig, interface: Interface) -> dict[str, PolicyModule]:
    """Return the policies' modules in the state of `checkpoint`. Reads pickles: use on trusted checkpoints only."""
    modules = module_spec(config.training, interface).build()
    modules.restore_from_path(checkpoint / MODULES)
    return {policy: modules[policy] for policy in interface.policy_ids}


def load_scales(checkpoint: Path, config: LeagueConfig) -> dict[str, ReturnNormalization]:
    """Return the units of values, by policy, in the state of `checkpoint`. Reads a pickle, as `load_modules` does."""
    if not (isinstance(config.training, PPOConfig) and config.training.normalize_values):
        return {}
    state = pickle.loads((checkpoint / MODULES.parent / "state.pkl").read_bytes())
    scales = {policy: ReturnNormalization() for policy in state[SCALES]}
    for policy, scale in scales.items():
        scale.load_state_dict(state[SCALES][policy])
    return scales


def git_commit(config_path: Path | None) -> str | None:
    """Return the HEAD commit of the repository that tracks the league's file, or None."""
    if config_path is None:
        return None
    directory, name = config_path.absolute().parent, config_path.name

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(directory), *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", name)
        return git("rev-parse", "HEAD")
    except (OSError, subprocess.CalledProcessError):
        return None
