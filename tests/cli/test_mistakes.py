"""Ten typical mistakes: the message is one line that names the file, key or line, and what to do."""

import os
import shutil
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from league.registry.registry import Registry
from tests.support.command import League
from tests.support.leagues import tictactoe

pytestmark = pytest.mark.usefixtures("ray_session", "short_examinations")  # `league train` starts a Ray otherwise

GAME = '''
import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv


class Guess(ParallelEnv):
    """Both agents observe a digit; the one who names it gets 1."""

    metadata = {"name": "guess"}
    possible_agents = ["a", "b"]
    most = 5

    def observation_space(self, agent):
        return spaces.Box(0, 9, (1,), np.float32)

    def action_space(self, agent):
        return spaces.Discrete(10)

    def reset(self, seed=None, options=None):
        self.rng, self.agents, self.steps = np.random.default_rng(seed), list(self.possible_agents), 0
        return self.observe(), {agent: {} for agent in self.agents}

    def observe(self):
        self.digit = int(self.rng.integers(10))
        return {agent: np.array([self.digit], np.float32) for agent in self.agents}

    def step(self, actions):
        self.steps += 1
        rewards = {agent: float(action == self.digit) for agent, action in actions.items()}
        observations = self.observe()
        ended = dict.fromkeys(self.agents, self.steps == self.most)
        if self.steps == self.most:
            self.agents = []
        return observations, rewards, ended, dict.fromkeys(ended, False), {agent: {} for agent in ended}
'''
TRAINING = {"runners": 0, "num_envs": 2, "steps": 64, "train_batch_size": 32, "minibatch_size": 32, "hidden": [8]}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current directory, with a game of the user."""
    folder = tmp_path / "project"
    folder.mkdir()
    (folder / f"guess_{tmp_path.name}.py").write_text(GAME)
    monkeypatch.chdir(folder)
    return folder


def module(folder: Path) -> Path:
    return next(folder.glob("*.py"))


def write(folder: Path, **changes: Any) -> Path:
    document = {
        "league": "guess",
        "environment": {"entry_point": f"{module(folder).stem}:Guess"},
        "training": TRAINING,
        **changes,
    }
    path = folder / "guess.yaml"
    path.write_text(yaml.safe_dump(document))
    return path


def replaced(folder: Path, old: str, new: str) -> int:
    """Change a line of the game; return its number."""
    text = module(folder).read_text()
    assert text.count(old) == 1
    text = text.replace(old, new)
    module(folder).write_text(text)
    return next(number for number, line in enumerate(text.splitlines(), 1) if new.splitlines()[-1].strip() in line)


def one_line(text: str) -> str:
    assert "Traceback" not in text
    (line,) = text.strip().splitlines()
    return line


def test_the_game_itself_is_sound(league: League, folder: Path) -> None:
    write(folder)
    result = league("check-env", "guess.yaml")
    assert result.code == 0, result.out
    assert "The environment passes" in result.out


def test_the_implementation_of_an_environment_is_named_and_compared(league: League, folder: Path) -> None:
    assert (
        "It is stepped in lockstep, because it has no vectorised implementation."
        in league("check-env", str(write(folder))).out
    )
    shown = " ".join(league("check-env", "tictactoe").out.split())
    assert "It is vectorised by league.environments.vector." in shown
    assert "The vectorised and the stock environment reported the same in " in shown
    assert " Steps per second: " in shown


def test_a_misspelt_key(league: League, folder: Path) -> None:
    write(folder, training={**TRAINING, "stesp": 5})
    result = league("train", "guess.yaml")
    assert result.code == 2
    assert one_line(result.err) == "league: guess.yaml: training.stesp: unknown key, did you mean 'steps'?"


def test_a_key_that_occurs_twice(league: League, folder: Path) -> None:
    path = write(folder)
    path.write_text(path.read_text() + "league: again\n")
    line = len(path.read_text().splitlines())
    result = league("train", "guess.yaml")
    assert result.code == 2
    assert one_line(result.err) == f"league: guess.yaml: line {line}: not valid YAML: the key 'league' occurs twice"


def test_a_line_that_is_not_yaml(league: League, folder: Path) -> None:
    with write(folder).open("a") as file:
        file.write("gate: {anchors: [}\n")
    result = league("train", "guess.yaml")
    assert result.code == 2
    line = len((folder / "guess.yaml").read_text().splitlines())
    assert one_line(result.err).startswith(f"league: guess.yaml: line {line}: not valid YAML: ")


def test_a_failing_import(league: League, folder: Path) -> None:
    line = replaced(folder, "import numpy as np", "import numpy as np\nimport no_such_library")
    write(folder)
    result = league("train", "guess.yaml")
    assert result.code == 2
    message = one_line(result.err)
    assert message.startswith("league: environment.entry_point: ")
    assert "No module named 'no_such_library'" in message
    assert f"{module(folder)}, line {line}" in message


def test_a_misspelt_function(league: League, folder: Path) -> None:
    write(folder, environment={"entry_point": f"{module(folder).stem}:Gues"})
    result = league("train", "guess.yaml")
    assert result.code == 2
    stem = module(folder).stem
    expected = f"environment.entry_point: {stem!r} ({module(folder)}) has no 'Gues', did you mean 'Guess'?"
    assert one_line(result.err) == f"league: {expected}"


CONSTRUCTOR = """    most = 5

    def __init__(self, side=3):
        self.side = side"""


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "    most = 5",
            f"{CONSTRUCTOR} + missing",
            "cannot be created ({place}): NameError: name 'missing' is not defined",
        ),
        ("    most = 5", f'{CONSTRUCTOR} + "a"', "cannot be created ({place}): TypeError: unsupported operand type(s)"),
        (
            "return spaces.Box(0, 9, (1,), np.float32)",
            "return self.space",
            "the spaces of a cannot be read ({place}): AttributeError: 'Guess' object has no attribute 'space'",
        ),
    ],
)
@pytest.mark.parametrize(("command", "code"), [("check-env", 1), ("train", 2)])
def test_an_exception_in_the_constructor(
    league: League, folder: Path, command: str, code: int, old: str, new: str, message: str
) -> None:
    line = replaced(folder, old, new)
    write(folder)
    result = league(command, "guess.yaml")
    assert result.code == code
    text = " ".join((result.out + result.err).split())
    assert message.format(place=f"{module(folder)}, line {line}") in text


def test_an_unknown_argument_of_the_constructor(league: League, folder: Path) -> None:
    replaced(folder, "    most = 5", CONSTRUCTOR)
    entry_point = f"{module(folder).stem}:Guess"
    write(folder, environment={"entry_point": entry_point, "kwargs": {"sied": 4}})
    result = league("train", "guess.yaml")
    assert result.code == 2
    message = f"environment.kwargs: {entry_point} does not accept them: "
    assert one_line(result.err).startswith(f"league: {message}")
    assert "'sied'" in result.err


def test_an_exception_in_step(league: League, folder: Path) -> None:
    line = replaced(folder, "self.steps += 1", "self.steps += self.speed")
    write(folder)
    result = league("check-env", "guess.yaml", "--json")
    assert result.code == 1
    (fault,) = [each["text"] for each in result.json["findings"] if each["severity"] == "fault"]
    assert f"{module(folder)}, line {line}, step 1 of the episode with seed 0" in fault
    assert "AttributeError: 'Guess' object has no attribute 'speed'" in fault


@pytest.mark.slow
def test_an_exception_in_step_during_training(league_process: League, folder: Path) -> None:
    line = replaced(folder, "self.steps += 1", "self.steps += self.speed")
    write(folder)
    result = league_process("train", "guess.yaml", timeout=400)
    assert result.code == 1
    message = result.err.strip().splitlines()[-1]
    assert f"'Guess' object has no attribute 'speed' at {module(folder)}:{line} in the episode with seed" in message


def test_an_endless_episode(league: League, folder: Path) -> None:
    replaced(folder, "most = 5", "most = None")
    write(folder, play={"max_moves": 200})
    result = league("check-env", "guess.yaml", "--json")
    assert result.code == 1
    (fault,) = [each["text"] for each in result.json["findings"] if each["severity"] == "fault"]
    assert "did not end within 200 steps (play.max_moves)" in fault
    assert "terminate or truncate it in the environment, or raise play.max_moves" in fault


def test_an_observation_outside_of_its_space(league: League, folder: Path) -> None:
    replaced(folder, "return spaces.Box(0, 9, (1,), np.float32)", "return spaces.Box(0, 9, (2,), np.float32)")
    write(folder)
    result = league("check-env", "guess.yaml", "--json")
    assert result.code == 1
    faults = [each for each in result.json["findings"] if each["severity"] == "fault"]
    expected = "observes observation with shape [1], but its space has [2]"
    assert faults[0]["text"] == f"{expected}: correct observation_space, or what reset and step return"
    assert faults[0]["agents"] == ["a", "b"]
    assert [each for each in result.json["findings"] if "not in its space" in each["text"]] == []


def test_a_value_outside_of_its_space(league: League, folder: Path) -> None:
    replaced(folder, "self.rng.integers(10)", "self.rng.integers(10, 11)")
    write(folder)
    result = league("check-env", "guess.yaml", "--json")
    notes = [each for each in result.json["findings"] if "observations are not in its space Box(0.0" in each["text"]]
    assert [each["example"] for each in notes] == ["observation[0] is 10, outside of [0, 9]"]


def test_an_observation_of_another_structure(league: League, folder: Path) -> None:
    replaced(folder, "np.array([self.digit], np.float32)", '{"digit": self.digit}')
    write(folder)
    result = league("check-env", "guess.yaml", "--json")
    assert result.code == 1
    (fault,) = [each["text"] for each in result.json["findings"] if each["severity"] == "fault"]
    expected = "a observes a dict with digit, but its space is Box(0.0, 9.0, (1,), float32)"
    assert fault == f"{expected}: correct observation_space, or what reset and step return"


def test_a_wrong_name_of_a_league(league: League, registry: Registry) -> None:
    result = league("versions", "tictactoo")
    assert result.code == 2
    assert one_line(result.err) == "league: there is no league 'tictactoo', did you mean 'tictactoe'?"


def test_a_wrong_name_of_a_configuration(league: League, folder: Path) -> None:
    write(folder)
    result = league("train", "gues")
    assert result.code == 2
    message = one_line(result.err)
    assert "'gues' is neither a YAML file nor a bundled configuration" in message
    assert message.endswith("for a league of your own, name its file")


def test_a_leagues_name_in_place_of_its_file(league: League, folder: Path) -> None:
    write(folder)
    result = league("train", "guess")
    assert result.code == 2
    assert one_line(result.err).endswith(": did you mean guess.yaml?")


@pytest.mark.parametrize(
    ("name", "end"),
    [("gess.yaml", "; did you mean guess.yaml?"), ("tictacto.yaml", "; did you mean tictactoe?"), ("x.yaml", "")],
)
def test_a_wrong_name_of_a_file(league: League, folder: Path, name: str, end: str) -> None:
    write(folder)
    result = league("train", name)
    assert (result.code, one_line(result.err)) == (2, f"league: {name}: No such file or directory{end}")


def test_the_files_of_a_version_were_deleted(league: League, registry: Registry, tmp_path: Path) -> None:
    """Each command names the directory and what to do, and no night passes over it."""
    for ref in ("tictactoe@1", "tictactoe@2"):  # the night has no other version to test
        assert league("remove", ref, "--yes").code == 0
    registry.aliases.set("tictactoe", "champion", 3, expected=None, actor="ann", reason="best")
    directory = registry.artifacts.path("tictactoe", 3)
    shutil.rmtree(directory)
    message = (
        f"tictactoe/3/manifest.json is missing: {directory} does not exist; mount its disk or restore it from a backup,"
        " or remove the version by `league remove tictactoe@3` and publish it again"
    )
    for command in (
        ("act", "tictactoe@3", "--local"),
        ("export", "tictactoe@3", str(tmp_path / "exported")),
        ("evaluate", "tictactoe", "tictactoe@3", "--blocks", "1", "--workers", "0"),
        ("promote", "tictactoe@3"),
        ("replay", "tictactoe@3", "script:random", "--out", str(tmp_path / "game.gif")),
    ):
        result = league(*command)
        assert (result.code, one_line(result.err)) == (1, f"league: {message}"), command
    night = league("nightly", "tictactoe", "--workers", "0")
    assert (night.code, f"tictactoe: {message}" in night.err) == (1, True)
    assert league("remove", "tictactoe@3", "--yes", "--force").code == 0


def test_one_contestant(league: League, registry: Registry) -> None:
    result = league("evaluate", "tictactoe", "tictactoe@1", "--schedule", "gauntlet", "--against", "tictactoe@1")
    assert (result.code, one_line(result.err).endswith("needs at least two contestants, got 1: tictactoe@1")) == (
        2,
        True,
    )


@pytest.fixture
def taken_port() -> Iterator[int]:
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        server.listen()
        yield server.getsockname()[1]


def test_a_port_in_use(league_process: League, registry: Registry, taken_port: int) -> None:
    result = league_process("serve", "--port", str(taken_port))
    assert result.code == 1
    message = result.err.strip().splitlines()[-1]
    assert message == (
        f"league: port {taken_port} of 127.0.0.1 is in use: stop the other server, or choose another with --port"
    )


def test_no_version_yet(league: League, home: Path) -> None:
    tictactoe.registry(home)
    result = league("promote", "tictactoe@1", "--yes")
    assert result.code == 2
    expected = "league tictactoe has no version 1; none is published yet: `league train CONFIG` publishes versions"
    assert one_line(result.err) == f"league: {expected}"


def test_code_is_found_from_another_directory(league: League, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(folder)
    monkeypatch.chdir(folder.parent)
    assert league("check-env", str(folder / "guess.yaml")).code == 0


def test_another_directory(league: League, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(folder)
    (folder.parent / "elsewhere").mkdir()
    monkeypatch.chdir(folder.parent / "elsewhere")
    module(folder).rename(folder.parent / "moved.py")
    result = league("train", os.path.relpath(folder / "guess.yaml"))
    assert result.code == 2
    message = one_line(result.err)
    assert "environment.entry_point: cannot import" in message
    assert f"searched: {folder}, " in message


@pytest.mark.parametrize(
    ("anchor", "message"),
    [
        ("script:one_pli", "unknown script 'one_pli'; known: random, "),
        ("@3", "league guess has no version yet: train it first"),
        ("tictactoe@1", "tictactoe@1 is not a version of league guess"),
    ],
)
@pytest.mark.parametrize(("command", "code"), [("check-env", 1), ("train", 2), ("nightly", 2)])
def test_an_invalid_anchor(league: League, folder: Path, command: str, code: int, anchor: str, message: str) -> None:
    write(folder, gate={"anchors": [anchor]})
    result = league(command, "guess.yaml")
    assert result.code == code
    assert f"gate.anchors: {message}" in result.out + result.err
