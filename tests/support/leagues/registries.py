"""A small league to register and publish: the spaces of tic-tac-toe, and files of a few bytes."""

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from sqlalchemy import update

from league.config.league import LeagueConfig
from league.interface import AgentInterface, Interface
from league.refs import CheckpointRef
from league.registry.aliases import ANY
from league.registry.registry import Registry
from league.registry.storage.manifest import TRAINING, Manifest, Parity, PolicyManifest, Tensor
from league.registry.storage.rows import EvaluationRow, RunRow, Traffic, VersionRow
from league.registry.traffic import setting_at
from league.spaces import Box, DictSpace, Discrete

LEAGUE = "tictactoe"
GRAPH = b"not a graph, but somebody's bytes"


def config(league: str = LEAGUE, **environment: Any) -> LeagueConfig:
    entry = {"entry_point": "pettingzoo.classic.tictactoe_v3"} | environment
    return LeagueConfig.from_mapping({"league": league, "environment": entry})


def interface(squares: int = 9) -> Interface:
    board = Box(dtype="int8", shape=(3, 3, 2), low=0, high=1)
    mask = Box(dtype="int8", shape=(squares,), low=0, high=1)
    spaces = AgentInterface(
        observation=DictSpace(spaces={"observation": board, "action_mask": mask}), action=Discrete(n=squares)
    )
    agents = ("player_1", "player_2")
    return Interface(
        agents=dict.fromkeys(agents, spaces),
        policies=dict.fromkeys(agents, "shared"),
        sides={agent: (agent,) for agent in agents},
    )


def manifest(number: int, league: str = LEAGUE, parent: int | None = None, squares: int = 9) -> Manifest:
    spaces_of_league = interface(squares)
    spaces = spaces_of_league.of_policy("shared")
    policy = PolicyManifest(
        file="shared.onnx",
        observation=spaces.observation,
        action=spaces.action,
        inputs=(
            Tensor(name="observation", dtype="int8", shape=(None, 3, 3, 2)),
            Tensor(name="action_mask", dtype="int8", shape=(None, squares)),
        ),
        outputs=(
            Tensor(name="action", dtype="int64", shape=(None,)),
            Tensor(name="action_dist_inputs", dtype="float32", shape=(None, squares)),
        ),
        parity=Parity(observations=2000, mismatches=0, near_ties=1, max_difference=3e-7),
    )
    environment = config(league).environment
    return Manifest(
        league=league,
        version=number,
        created_at=datetime.now(UTC),
        interface=spaces_of_league,
        policies={"shared": policy},
        environment=environment,
        environment_digest=environment.digest(),
        algorithm="ppo",
        settings={"lr": 3e-4},
        seed=1,
        steps=1000 * number,
        parent=parent,
        stack={"onnxruntime": "1.0"},
    )


def builder(
    league: str = LEAGUE, parent: int | None = None, graph: bytes = GRAPH, squares: int = 9
) -> Callable[[Path, int], Manifest]:
    """A build function that writes a graph, and a training state of two files."""

    def build(directory: Path, number: int) -> Manifest:
        (directory / "shared.onnx").write_bytes(graph)
        (directory / "training" / "learner").mkdir(parents=True)
        (directory / "training" / "state.bin").write_bytes(bytes(range(256)))
        (directory / "training" / "learner" / "weights.bin").write_bytes(b"weights")
        return manifest(number, league, parent, squares)

    return build


def publish(registry: Registry, source: str, league: str = LEAGUE, parent: int | None = None) -> VersionRow:
    return registry.publisher.publish(league, builder(league, parent), source=source, parent=parent)


def registered(registry: Registry, league: str = LEAGUE, versions: int = 0) -> Registry:
    """Add the league and this number of versions to the registry; returns the registry."""
    registry.leagues.register(config(league), interface())
    for i in range(versions):
        publish(registry, f"run/{i}", league)
    return registry


def promote(registry: Registry, version: int, league: str = LEAGUE) -> None:
    """Make a version the champion, whichever it is."""
    registry.aliases.set(league, "champion", version, expected=ANY, actor="test", reason="test")


def expire_heartbeats(registry: Registry, table: type[RunRow] | type[EvaluationRow]) -> None:
    with registry.database.write() as session:
        session.execute(update(table).values(heartbeat_at=datetime.now(UTC) - timedelta(days=1)))


def leftovers(registry: Registry, league: str = LEAGUE) -> list[str]:
    """Names of the files in a league's artifact directory other than ready versions."""
    directory = registry.artifacts.root / league
    ready = {str(version.number) for version in registry.versions.all(league)}
    return sorted(p.name for p in directory.iterdir() if p.name not in ready) if directory.exists() else []


def traffic_history(registry: Registry, league: str = LEAGUE) -> list[Traffic]:
    """All traffic settings of a league, newest first."""
    with registry.database.read() as session:
        settings, before = [], setting_at(session, league)
        while before is not None:
            settings.append(before)
            before = setting_at(session, league, (before.id or 0) - 1)
        return settings


def verified(registry: Registry, number: int, league: str = LEAGUE) -> Manifest:
    """The manifest of a version, after reading and verifying all files that it has."""
    version = registry.versions.with_files(CheckpointRef(league, number))
    manifest = registry.artifacts.verify_names(league, number, version.sha256)
    for name in manifest.files:
        if registry.versions.has_training(version) or not name.startswith(TRAINING):
            registry.artifacts.read(manifest, name)
    return manifest
