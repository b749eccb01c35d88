"""A package in an environment of its own adds to a league, and a replica without it serves the champion."""

import os
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest
import yaml

import policy_league
import policy_league_client
from league.registry.registry import Registry
from league.settings import Storage

pytestmark = pytest.mark.slow

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
    width = 32

    def __init__(self, space):
        super().__init__()
        self.layers = torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(18, self.width), torch.nn.Tanh())

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
    "training": {
        "algorithm": "acme",
        "patience": 2,
        "network": {"entry_point": "acme_league:Net"},
        "callbacks": ["acme_league:Episodes"],
        "wrappers": ["acme_league:Shaped"],
        "trackers": ["acme_league:Journal"],
        "opponents": [{"ref": "script:acme_league:First", "share": 0.5}],
        "steps": 256,
        "runners": 1,
        "num_envs": 4,
        "train_batch_size": 128,
        "minibatch_size": 64,
        "epochs": 1,
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
"""


def run(*command: str | Path) -> str:
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def test_a_package_trains_a_champion_that_a_replica_without_it_serves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
    assert "Code: acme_league:Acme, SHA-256" in output
    assert "plies" in output
    run(*command, "promote", "acme@1", "--yes")
    registry = Registry.open(Storage.at(home))
    (version,) = registry.versions.all("acme")
    assert (version.manifest.algorithm, version.manifest.settings["patience"]) == ("acme_league:Acme", 2)
    registry.close()
    (journal,) = (home / "runs/acme").glob("*/journal.jsonl")
    assert '["version", "acme@1", [' in (text := journal.read_text())
    assert '["end", "ended"]' in text
    assert "'action': 4" in run(sys.executable, "-c", SERVER, home)
