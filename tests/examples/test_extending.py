"""The examples of docs/extending.md from training to matches, and a server that cannot import what trained."""

import io
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from rich.console import Console
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from evaluation.matches.tournament import evaluate
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.errors import LeagueError
from league.registry.registry import Registry
from league.settings import Storage
from training.algorithms.rllib_config import with_algorithm
from training.export.publish import Checkpoint, publish
from training.runs.run_directory import RUN_FILE, RunRecord
from training.runs.train import check, train
from training.runs.trial import build_algorithm

PAGE = (Path(__file__).parents[2] / "docs/extending.md").read_text()
LEAGUES = {league["league"]: league for league in map(yaml.safe_load, re.findall(r"```yaml\n(.*?)```", PAGE, re.S))}
pytestmark = pytest.mark.slow
SHORT = {"runners": 0, "num_envs": 4, "train_batch_size": 64, "minibatch_size": 32, "epochs": 1}
SHORT_OFF_POLICY = {"runners": 0, "num_envs": 4, "learning_starts": 64, "batch_size": 32}


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    registry = Registry.open(Storage.at(tmp_path / "home"))
    yield registry
    registry.close()


def publish_short_training(registry: Registry, config: LeagueConfig, path: Path) -> None:
    """Publish the state after one update, in this process."""
    spaces = interface(config)
    registry.leagues.register(config, spaces)
    algorithm = build_algorithm(config, spaces)
    try:
        algorithm.train()
        algorithm.save_to_path(str(path))
    finally:
        algorithm.stop()
    source = Checkpoint(path, source="run/64", steps=64)
    row = publish(source, registry=registry, config=config, interface=spaces, parent=None, git_commit=None)
    assert all(policy.parity.mismatches == 0 for policy in row.manifest.policies.values())


@pytest.mark.usefixtures("ray_session")
@pytest.mark.parametrize("name", LEAGUES)
def test_an_example_trains_and_its_version_plays(name: str, registry: Registry, tmp_path: Path) -> None:
    document: dict[str, Any] = LEAGUES[name]
    short = SHORT_OFF_POLICY if name == "tictactoe_sac" else SHORT
    config = with_algorithm(LeagueConfig.from_mapping(document | {"training": document["training"] | short}))
    check(config, interface(config))
    publish_short_training(registry, config, tmp_path / "64")
    report = evaluate(name, ("script:random", f"{name}@1"), registry=registry, blocks=2)
    assert report.games > 0
    assert report.forfeits == {}


CALLBACK = """
class Wins:
    def __init__(self):
        self.versions = []

    def on_episode(self, episode):
        return {"length": episode.length, "agents": len(episode.returns)}

    def on_update(self, metrics):
        if FAULTY and metrics["steps"] >= 128:
            raise RuntimeError("too late")
        return {"updates": metrics["steps"] / 64}

    def on_version(self, version):
        self.versions.append(version.ref)

    def on_end(self, versions):
        assert self.versions == [version.ref for version in versions][-len(self.versions) :]
        print(self.versions)
"""


@pytest.mark.usefixtures("ray_session")
def test_a_callback_adds_metrics_and_its_fault_ends_a_run_that_can_be_resumed(
    registry: Registry, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    modules = {name: tmp_path / f"{name}.py" for name in ("faulty_callback_of_test", "callback_of_test")}
    for name, file in modules.items():
        file.write_text(f"FAULTY = {name.startswith('faulty')}\n{CALLBACK}")

    def league(name: str) -> LeagueConfig:
        settings = SHORT | {"steps": 256, "checkpoint_every": 64, "strength": None, "callbacks": [f"{name}:Wins"]}
        environment = {"entry_point": "pettingzoo.classic.tictactoe_v3"}
        document = {"league": "called", "folder": str(tmp_path), "environment": environment, "training": settings}
        return LeagueConfig.from_mapping(document)

    faulty, correct = modules
    line = CALLBACK[: CALLBACK.index("raise")].count("\n") + 2
    place = f"{faulty}:Wins.on_update raises ({modules[faulty]}, line {line}): RuntimeError: too late"
    with pytest.raises(LeagueError, match=re.escape(f"training.callbacks: {place}; training ended")):
        train(league(faulty), registry=registry)
    assert registry.versions.all("called"), "the state is published"
    (run,) = registry.runs.newest("called")
    assert run.state == "failed"
    capsys.readouterr()
    output = io.StringIO()
    versions = train(league(correct), registry=registry, resume=True, console=Console(file=output, width=500))
    assert versions[-1].steps >= 256
    assert str([versions[-1].ref])[1:] in capsys.readouterr().out
    assert re.search(r"; length \d[\d.]*, agents 2, updates [45]", output.getvalue())
    curves = registry.runs.get("called", run.id).curves
    assert 5 <= curves["callbacks/length"] <= 9
    assert (curves["callbacks/agents"], curves["callbacks/updates"]) == (2, versions[-1].steps / 64)
    (events,) = (registry.storage.home / f"runs/called/{run.id}/attempt-2").glob("events.*")
    events_of_run = EventAccumulator(str(events))
    events_of_run.Reload()
    assert {"callbacks/length", "callbacks/updates"} <= set(events_of_run.Tags()["scalars"])


CODE = """
from league.config.ppo import PPOConfig
from torch import nn
from training.algorithms.ppo import PPO
from training.learners.ppo import PPOLearner

class Config(PPOConfig):
    scale: float = 2.0

class Learner(PPOLearner):
    def update(self, **arguments):
        assert type(self.settings) is Config and self.settings.scale == 2
        return super().update(**arguments)

class Algorithm(PPO):
    settings_class = Config
    learner_class = Learner

class Net(nn.Module):
    def __init__(self, space, width):
        super().__init__()
        self.width = width
        self.layers = nn.Sequential(nn.Flatten(), nn.Linear(18, width), nn.Tanh())

    def forward(self, observations):
        return self.layers(observations["observation"].float())
"""
SERVER = """
import sys
from importlib.util import find_spec
from pathlib import Path

from league.settings import Storage
from tests.support.servers.replicas import replica

with replica(Storage.at(Path(sys.argv[1]))) as client:
    rows = {"observation": [[[0, 0]] * 3] * 3, "action_mask": [0, 0, 0, 0, 1, 0, 0, 0, 0]}
    print(client.post("/v1/policies/own_net/action?version=1", json={"observation": rows}).json())
    print(client.get("/v1/leagues/own_net").json())
assert find_spec("own_net_of_test") is None
assert "torch" not in sys.modules
"""


@pytest.mark.usefixtures("ray_session")
def test_a_server_without_the_code_of_the_network_and_the_algorithm(registry: Registry, tmp_path: Path) -> None:
    folder = tmp_path / "league"
    folder.mkdir()
    (folder / "own_net_of_test.py").write_text(CODE)
    network = {"entry_point": "own_net_of_test:Net", "kwargs": {"width": 16}}
    document = {
        "league": "own_net",
        "environment": {"entry_point": "pettingzoo.classic.tictactoe_v3"},
        "training": SHORT
        | {"algorithm": "own_net_of_test:Algorithm", "network": network, "runners": 1, "steps": 128, "strength": None},
    }
    (folder / "own_net.yaml").write_text(yaml.safe_dump(document))
    config = LeagueConfig.load(folder / "own_net.yaml")
    output = io.StringIO()
    (version,) = train(config, registry=registry, console=Console(file=output, width=200))
    assert version.manifest.settings["network"] == network
    assert version.manifest.settings["scale"] == 2
    assert registry.leagues.get("own_net").config.training.algorithm == "own_net_of_test:Algorithm"
    (run,) = (registry.storage.home / "runs/own_net").iterdir()
    record = RunRecord.model_validate_json((run / RUN_FILE).read_text())
    assert record.code == config.training_code()
    assert f"Code: own_net_of_test:Net, SHA-256 {record.code['own_net_of_test:Net']}." in output.getvalue()
    (folder / "own_net_of_test.py").unlink()
    served = subprocess.run(
        [sys.executable, "-c", SERVER, str(registry.storage.home)], capture_output=True, text=True, check=False
    )
    assert served.returncode == 0, served.stderr
    answer, league = served.stdout.splitlines()
    assert "'action': 4" in answer
    assert "own_net" in league
