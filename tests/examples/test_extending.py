"""The examples of docs/extending.md from training to matches, and code of others that a server does not have."""

import io
import os
import re
import subprocess
import sys
import sysconfig
import venv
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from rich.console import Console
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import policy_league
import policy_league_client
from evaluation.matches.tournament import evaluate
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.errors import LeagueError
from league.registry.registry import Registry
from league.settings import Storage
from tests.support.algorithms import running
from training.algorithms.rllib_config import with_algorithm
from training.export.publish import Checkpoint, publish
from training.runs.run_directory import RUN_FILE, RunRecord
from training.runs.train import check, train

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
    with running(config) as algorithm:
        algorithm.train()
        algorithm.save_to_path(str(path))
    source = Checkpoint(path, source="run/64", steps=64)
    row = publish(source, registry=registry, config=config, interface=spaces, parent=None, git_commit=None)
    assert all(policy.parity.mismatches == 0 for policy in row.manifest.policies.values())


@pytest.mark.usefixtures("ray_session")
@pytest.mark.parametrize(
    ("name", "settings"),
    [
        *((name, {}) for name in LEAGUES),
        ("connect_four_residual", {"recurrence": {"width": 4, "sequence": 4}}),
        ("tictactoe_separate_critic", {"recurrence": {"width": 4, "sequence": 4}}),
    ],
)
def test_an_example_trains_and_its_version_plays(
    name: str, settings: dict[str, Any], registry: Registry, tmp_path: Path
) -> None:
    document: dict[str, Any] = LEAGUES[name]
    short = settings | (SHORT_OFF_POLICY if name == "tictactoe_sac" else SHORT)
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


PYPROJECT = """
[build-system]
requires = ["setuptools"]
build-backend = "setuptools.build_meta"

[project]
name = "acme-league"
version = "1.0"

[project.entry-points."policy_league.algorithms"]
acme = "acme_league:Acme"

[tool.setuptools]
py-modules = ["acme_league"]
"""


PACKAGE = """
import json

import torch
from pettingzoo.utils.wrappers import BaseWrapper

from league.config.ppo import PPOConfig
from training.algorithms.ppo import PPO
from training.learners.ppo import PPOLearner


class Settings(PPOConfig):
    patience: int = 3


class Learner(PPOLearner):
    def update(self, **arguments):
        assert self.settings.patience == 2
        return super().update(**arguments)


class Acme(PPO):
    settings_class = Settings
    learner_class = Learner


class Net(torch.nn.Module):
    def __init__(self, space, width):
        super().__init__()
        self.width = width
        self.layers = torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(18, width), torch.nn.Tanh())

    def forward(self, observations):
        return self.layers(observations["observation"].float())


class Episodes:
    def on_episode(self, episode):
        return {"plies": episode.length}


class Shaped(BaseWrapper):
    def last(self, observe=True):
        observation, reward, *ended = super().last(observe)
        return observation, reward - 0.01, *ended


class First:
    def act(self, observation, action_mask):
        return int(action_mask.argmax())


class Journal:
    def __init__(self, run):
        self.file = run.path / "journal.jsonl"

    def write(self, *entry):
        with self.file.open("a") as file:
            file.write(json.dumps(entry) + "\\n")

    def log(self, values, step):
        self.write("curves", sorted(values), step)

    def add(self, ref, files, about):
        self.write("version", ref, sorted(file.name for file in files.iterdir()))

    def end(self, state):
        self.write("end", state)
"""


LEAGUE = {
    "league": "acme",
    "environment": {"entry_point": "pettingzoo.classic.tictactoe_v3"},
    "training": SHORT
    | {
        "algorithm": "acme",
        "patience": 2,
        "network": {"entry_point": "acme_league:Net", "kwargs": {"width": 16}},
        "callbacks": ["acme_league:Episodes"],
        "wrappers": ["acme_league:Shaped"],
        "trackers": ["acme_league:Journal"],
        "opponents": [{"ref": "script:acme_league:First", "share": 0.5}],
        "steps": 256,
        "runners": 1,
        "train_batch_size": 128,
        "minibatch_size": 64,
        "strength": None,
    },
    "gate": {"anchors": ["script:acme_league:First"]},
}


SERVER = """
import sys
from importlib.util import find_spec
from pathlib import Path

from league.settings import Storage
from tests.support.servers.replicas import replica

with replica(Storage.at(Path(sys.argv[1]))) as client:
    rows = {"observation": [[[0, 0]] * 3] * 3, "action_mask": [0, 0, 0, 0, 1, 0, 0, 0, 0]}
    print(client.post("/v1/policies/acme/action", json={"observation": rows}).json())
assert find_spec("acme_league") is None
assert "torch" not in sys.modules
"""


def run(*command: str | Path) -> str:
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def test_a_package_trains_what_a_replica_without_it_serves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is installed in an environment of its own; the replica has neither its code nor torch."""
    package, environment, home = tmp_path / "package", tmp_path / "venv", tmp_path / "home"
    package.mkdir()
    (package / "pyproject.toml").write_text(PYPROJECT)
    (package / "acme_league.py").write_text(PACKAGE)
    venv.create(environment, symlinks=True)
    python = environment / "bin/python"
    (site_packages,) = environment.glob("lib/python*/site-packages")
    # In addition to its own: what this process has, the product included.
    paths = [path for path in sys.path if path and os.path.isdir(path)]
    # Those of the project are not on the path if it is installed as editable.
    project = [str(Path(module.__file__ or "").parents[1]) for module in (policy_league, policy_league_client)]
    paths = [*project, *paths, sysconfig.get_path("purelib")]
    (site_packages / "checkout.pth").write_text("\n".join(dict.fromkeys(paths)))
    run(python, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index", package)
    league = tmp_path / "acme.yaml"
    league.write_text(yaml.safe_dump(LEAGUE))
    command = [python, "-c", "from policy_league.cli.main import run; run()"]
    monkeypatch.setenv("LEAGUE_HOME", str(home))
    output = run(*command, "train", league)
    assert "plies" in output
    run(*command, "promote", "acme@1", "--yes")
    registry = Registry.open(Storage.at(home))
    (version,) = registry.versions.all("acme")
    settings = version.manifest.settings
    assert (version.manifest.algorithm, settings["patience"]) == ("acme_league:Acme", 2)
    assert settings["network"] == LEAGUE["training"]["network"]
    registry.close()
    (directory,) = (home / "runs/acme").iterdir()
    code = RunRecord.model_validate_json((directory / RUN_FILE).read_text()).code
    for name in ("Acme", "Net"):
        assert f"acme_league:{name}, SHA-256 {code[f'acme_league:{name}']}" in output
    journal = (directory / "journal.jsonl").read_text()
    assert '["version", "acme@1", [' in journal
    assert '["end", "ended"]' in journal
    assert "'action': 4" in run(sys.executable, "-c", SERVER, home)
