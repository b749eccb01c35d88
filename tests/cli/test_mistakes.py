"""Mistakes: one line on stderr that names what is wrong and what to do, and nothing in the registry changes."""

import os
import shutil
import socket
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml

from league.registry.registry import Registry
from tests.support.command import League
from tests.support.leagues import tictactoe
from tests.support.leagues.judged_league import promote

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
    environment = {"entry_point": f"{module(folder).stem}:Guess"}
    path = folder / "guess.yaml"
    path.write_text(yaml.safe_dump({"league": "guess", "environment": environment, "training": TRAINING, **changes}))
    return path


def replaced(folder: Path, old: str, new: str) -> int:
    """Change a line of the game; return its number."""
    text = module(folder).read_text()
    assert text.count(old) == 1
    text = text.replace(old, new)
    module(folder).write_text(text)
    return next(number for number, line in enumerate(text.splitlines(), 1) if new.splitlines()[-1].strip() in line)


def refused(league: League, *command: str, code: int = 2) -> str:
    """The only line of a refusal, without the name of the program."""
    result = league(*command)
    assert (result.code, "Traceback" in result.err) == (code, False), result.err
    (line,) = result.err.strip().splitlines()
    assert line.startswith("league: ")
    return line.removeprefix("league: ")


def test_a_sound_game_passes_and_is_found_from_another_directory(
    league: League, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = league("check-env", str(write(folder)))
    assert (result.code, "The environment passes" in result.out) == (0, True), result.out
    assert "It is stepped in lockstep, because it has no vectorised implementation." in result.out
    page = " ".join(league("check-env", "tictactoe").out.split())
    assert "It is vectorised by league.environments.vector." in page
    assert "The vectorised and the stock environment reported the same in " in page
    assert " Steps per second: " in page
    monkeypatch.chdir(folder.parent)
    assert league("check-env", str(folder / "guess.yaml")).code == 0


def test_a_module_that_was_moved(league: League, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(folder)
    monkeypatch.chdir(folder.parent)
    module(folder).rename(folder.parent / "moved.py")
    message = refused(league, "train", os.path.relpath(folder / "guess.yaml"))
    assert "environment.entry_point: cannot import" in message
    assert f"searched: {folder}, " in message


def test_a_key_or_a_line_that_is_wrong(league: League, folder: Path) -> None:
    path = write(folder, training={**TRAINING, "stesp": 5})
    assert refused(league, "train", path.name) == "guess.yaml: training.stesp: unknown key, did you mean 'steps'?"
    document = write(folder).read_text()
    line = 1 + len(document.splitlines())
    path.write_text(document + "league: again\n")
    expected = f"guess.yaml: line {line}: not valid YAML: the key 'league' occurs twice"
    assert refused(league, "train", path.name) == expected
    path.write_text(document + "gate: {anchors: [}\n")
    assert refused(league, "train", path.name).startswith(f"guess.yaml: line {line}: not valid YAML: ")


def test_a_wrong_name_of_a_configuration_or_a_function(league: League, folder: Path) -> None:
    write(folder)
    for name, end in (("gess", "; did you mean guess.yaml?"), ("tictacto", "; did you mean tictactoe?"), ("x", "")):
        assert refused(league, "train", f"{name}.yaml") == f"{name}.yaml: No such file or directory{end}"
    message = refused(league, "train", "gues")
    assert "'gues' is neither a YAML file nor a bundled configuration" in message
    assert message.endswith("for a league of your own, name its file")
    assert refused(league, "train", "guess").endswith(": did you mean guess.yaml?"), "the name of the league"
    stem = module(folder).stem
    write(folder, environment={"entry_point": f"{stem}:Gues"})
    expected = f"environment.entry_point: {stem!r} ({module(folder)}) has no 'Gues', did you mean 'Guess'?"
    assert refused(league, "train", "guess.yaml") == expected


def test_a_failing_import(league: League, folder: Path) -> None:
    line = replaced(folder, "import numpy as np", "import numpy as np\nimport no_such_library")
    message = refused(league, "train", str(write(folder)))
    assert message.startswith("environment.entry_point: ")
    assert "No module named 'no_such_library'" in message
    assert f"{module(folder)}, line {line}" in message


CONSTRUCTOR = """    most = 5

    def __init__(self, side=3):
        self.side = side"""


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "    most = 5",
            f"{CONSTRUCTOR} + missing",
            "cannot be created ({place}): NameError: name 'missing' is not defin",
        ),
        (
            "return spaces.Box(0, 9, (1,), np.float32)",
            "return self.space",
            "the spaces of a cannot be read ({place}): AttributeError: 'Guess' object has no attribute 'space'",
        ),
    ],
)
def test_an_exception_in_the_constructor(league: League, folder: Path, old: str, new: str, message: str) -> None:
    line = replaced(folder, old, new)
    for command, code in (("check-env", 1), ("train", 2)):
        result = league(command, str(write(folder)))
        assert result.code == code
        text = " ".join((result.out + result.err).split())
        assert message.format(place=f"{module(folder)}, line {line}") in text


BOX = "return spaces.Box(0, 9, (1,), np.float32)"


OTHER_SHAPE = "observes observation with shape [1], but its space has [2]: correct observation_space, or what reset"


RAISED = ("{place}, step 1 of the episode with seed 0", "AttributeError: 'Guess' object has no attribute 'speed'")


@pytest.mark.parametrize(
    ("old", "new", "parts"),
    [
        ("self.steps += 1", "self.steps += self.speed", RAISED),
        (BOX, BOX.replace("(1,)", "(2,)"), (OTHER_SHAPE,)),
    ],
    ids=["exception", "shape"],
)
def test_a_fault_of_the_environment(league: League, folder: Path, old: str, new: str, parts: tuple[str, ...]) -> None:
    line = replaced(folder, old, new)
    result = league("check-env", str(write(folder)), "--json")
    assert result.code == 1
    (fault,) = [finding["text"] for finding in result.json["findings"] if finding["severity"] == "fault"]
    for part in parts:
        assert part.format(place=f"{module(folder)}, line {line}") in fault
    assert [finding for finding in result.json["findings"] if "not in its space" in finding["text"]] == []


@pytest.mark.slow
def test_an_exception_in_step_during_training(league_process: League, folder: Path) -> None:
    line = replaced(folder, "self.steps += 1", "self.steps += self.speed")
    write(folder)
    result = league_process("train", "guess.yaml", timeout=400)
    assert result.code == 1
    message = result.err.strip().splitlines()[-1]
    assert f"'Guess' object has no attribute 'speed' at {module(folder)}:{line} in the episode with seed" in message


def test_the_files_of_a_version_were_deleted(league: League, registry: Registry, tmp_path: Path) -> None:
    """Each command names the directory and what to do, and no night passes over it."""
    for ref in ("tictactoe@1", "tictactoe@2"):  # the night has no other version to test
        assert league("remove", ref, "--yes").code == 0
    directory = promote(registry, 3).artifacts.path("tictactoe", 3)
    shutil.rmtree(directory)
    message = (
        f"tictactoe/3/manifest.json is missing: {directory} does not exist; mount its disk or restore it from a backup,"
        " or remove the version by `league remove tictactoe@3` and publish it again"
    )
    for command in (
        "act tictactoe@3 --local",
        f"export tictactoe@3 {tmp_path / 'exported'}",
        "evaluate tictactoe tictactoe@3 --blocks 1 --workers 0",
        "promote tictactoe@3",
        f"replay tictactoe@3 script:random --out {tmp_path / 'game.gif'}",
    ):
        assert refused(league, *command.split(), code=1) == message, command
    night = league("nightly", "tictactoe", "--workers", "0")
    assert (night.code, f"tictactoe: {message}" in night.err) == (1, True)
    assert league("remove", "tictactoe@3", "--yes", "--force").code == 0


@pytest.mark.usefixtures("registry")
def test_a_port_in_use(league_process: League) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        result = league_process("serve", "--port", str(port))
    assert result.code == 1
    message = f"league: port {port} of 127.0.0.1 is in use: stop the other server, or choose another with --port"
    assert result.err.strip().splitlines()[-1] == message


@pytest.mark.parametrize(("command", "code"), [("check-env", 1), ("train", 2), ("nightly", 2)])
def test_an_invalid_anchor(league: League, folder: Path, command: str, code: int) -> None:
    result = league(command, str(write(folder, gate={"anchors": ["@3"]})))
    assert result.code == code
    assert "gate.anchors: league guess has no version yet: train it first" in result.out + result.err


Rows = Sequence[tuple[int, str, str]]
"""Exit code, command and what its line contains."""


OF_VERSIONS: Rows = [
    (2, "versions chess", "there is no league 'chess'"),
    (2, "versions tictactoo", "there is no league 'tictactoo', did you mean 'tictactoe'?"),
    (2, "versions A/B", "'A/B' must consist of"),
    (2, "promote tictactoe@9 --yes", "league tictactoe has no version 9; the newest is 5"),
    (2, "promote tictactoe@champion --yes", "champion"),
    (2, "promote tictactoe", "contains no version"),
    (2, "promote tictactoe@1 --yes --alias 12", "version number"),
    (2, "promote tictactoe@1 --yes --expected x", "--expected"),
    (2, "promote empty@1 --yes", "none is published yet: `league train CONFIG` publishes versions"),
    (1, "promote tictactoe@4", "tictactoe@4 has the role exploiter (of tictactoe@3): it cannot be promoted"),
    (1, "rollback tictactoe", "alias champion of league tictactoe is not set: promote a version"),
    (2, "history tictactoe --at noon", "--at 'noon'"),
    (2, "retire other --yes", "there is no league 'other'"),
    (2, "search tictactoe@1", "tictactoe@1 has no value graph"),
    (2, "mixture empty", "expected at least two versions, the league has 0: `league train CONFIG` publishes them"),
    (2, "mixture tictactoe --method best", "'best': expected nash or alpha_rank"),
    (2, "export tictactoe@3 --hub --mlflow", "--hub and --mlflow have different targets"),
    (2, "export tictactoe@mixed", "tictactoe@5 is a mixture (@1 50.0 %, @2 50.0 %): name one of its members"),
    (2, "import tictactoe nowhere.onnx", "nowhere.onnx: no such file"),
]


MIXTURES: Rows = [
    (
        1,
        "promote tictactoe@3:0.5,@4:0.5 --yes",
        "tictactoe@4 has the role exploiter (of tictactoe@3): it cannot be in a",
    ),
    (2, "promote tictactoe@1:0.6,tictactoe@9:0.4 --yes", "league tictactoe has no version 9; the newest is 5"),
    (2, "promote tictactoe@1:0.6,tictactoe@2:0.3 --yes", "the probabilities of the mixture sum to 0.9, expected 1"),
    (2, "promote tictactoe@1:0.6,chess@2:0.4 --yes", "chess@2 is not a version of league tictactoe: a mixture has one"),
    (2, "promote tictactoe@1:0.6,@2 --yes", "'@2' has no probability: expected LEAGUE@VERSION:PROBABILITY"),
    (2, "promote tictactoe@1:x,tictactoe@2:0.4 --yes", "'x' is not a probability: expected tictactoe@1:PROBABILITY"),
    (2, "promote tictactoe@1:0.5,tictactoe@1:0.5 --yes", "tictactoe@1 is twice in the mixture"),
    (2, "promote tictactoe@1:1 --yes", "a mixture has 1 version, expected at least two"),
    (2, "promote tictactoe@mixed:0.5,@1:0.5 --yes", "tictactoe@5 is a mixture (@1 50.0 %, @2 50.0 %): name one of its"),
]


GAMES: Rows = [
    (2, "evaluate tictactoe connect_four@1", "connect_four@1"),
    (2, "evaluate tictactoe script:stockfish", "stockfish"),
    (2, "evaluate tictactoe --against tictactoe@1", "only a gauntlet"),
    (2, "evaluate tictactoe --minutes 0", "got 0"),
    (2, "evaluate tictactoe --precision -5", "got -5"),
    (2, "evaluate tictactoe --schedule cross_play", "2 side(s)"),
    (
        2,
        "evaluate tictactoe tictactoe@1 --schedule gauntlet --against tictactoe@1",
        "needs at least two contestants, got 1: tictactoe@1\n",
    ),
    (2, "nightly nowhere.yaml", "nowhere.yaml: No such file"),
    (2, "void nothing --reason x", "nothing"),
    (2, "exploitability tictactoe@2", "tictactoe@2 has no exploiters: train one with"),
    (2, "replay --out game.gif", "expected a contestant"),
    (2, "replay tictactoe@1 --match x/0", "remove tictactoe@1"),
    (2, "report chess", "chess"),
    (2, "report tictactoe --json --out page.html", "cannot be combined with --out page.html"),
    (1, "report tictactoe --out nowhere/page.html", "cannot be written"),
]


SERVERS: Rows = [
    (2, "act script:random", "script"),
    (2, "act tictactoe@1 --local -o [[[", "not valid JSON"),
    (2, 'act tictactoe@1 --local -o {"observation":[[1]]}', "action_mask"),
    (2, "act tictactoe@1 --local --policy other", "other"),
    (2, "act tictactoe@1 --local --analysis", "--analysis: tictactoe@1 does not search"),
    (2, "keys create x --scope fly", "fly"),
    (2, "keys create x --scope act --rate fast", "--rate 'fast': expected a number"),
    (2, "keys create x --scope act --expires soon", "--expires 'soon': expected a number"),
    (2, "keys create x --scope act --league A*", "A*"),
    (2, "keys revoke nobody", "nobody"),
    (2, "replicas --remove other", "no replica 'other'"),
    (2, "traffic tictactoe --share 0.2", "a share requires a version: --canary REF"),
    (2, "traffic tictactoe --off --canary 3", "--off"),
    (2, "traffic tictactoe --canary connect_four@3", "expected a version of league tictactoe"),
    (2, "traffic tictactoe --canary 9", "no version 9"),
    (2, "traffic tictactoe --shadow champion", "champion"),
]


OF_TRAINING: Rows = [
    (2, "train nowhere.yaml", "nowhere.yaml: No such file"),
    (2, "train tictactoe --against @1", "--role exploiter"),
    (1, "train other.yaml", "league tictactoe has versions with other spaces or policies than this configuration"),
    (
        1,
        "nightly other.yaml --train",
        "tictactoe: league tictactoe has versions with other spaces or policies than this",
    ),
    (
        2,
        "train same.yaml --role exploiter --against @champion",
        "league tictactoe has no alias 'champion'; known: mixed",
    ),
]


OTHER_GAME = """
league: tictactoe
environment: {entry_point: pettingzoo.classic.connect_four_v3}
policies: {shared: ["player_*"]}
training: {steps: 64, opponents: {league: {}}}
"""


@pytest.mark.parametrize("rows", [OF_VERSIONS, MIXTURES, GAMES, SERVERS, OF_TRAINING], ids=lambda rows: rows[0][1])
def test_a_refusal_is_one_line_and_changes_nothing(
    league: League,
    registry: Registry,
    rows: Rows,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    subtests: pytest.Subtests,
) -> None:
    """In a league with the exploiter @4 and the mixture @5, and another one without versions."""
    monkeypatch.chdir(tmp_path)
    Path("other.yaml").write_text(OTHER_GAME)
    Path("same.yaml").write_text(OTHER_GAME.replace("connect_four", "tictactoe"))
    tictactoe.publish(registry, tictactoe.graph(), exploits="tictactoe@3")
    mixture = registry.publisher.publish_mixture("tictactoe", {1: 0.5, 2: 0.5}).number
    registry.aliases.set("tictactoe", "mixed", mixture, expected=None, actor="me", reason="test")
    registry.leagues.register(
        tictactoe.config().model_copy(update={"league": "empty"}), registry.leagues.get("tictactoe").interface
    )

    def state() -> object:
        versions = [(row.number, row.retired_at) for row in registry.versions.all("tictactoe")]
        return (
            registry.aliases.current("tictactoe"),
            versions,
            registry.keys.all(),
            registry.traffic.current("tictactoe"),
        )

    before = state()
    for code, command, message in rows:
        result = league(*command.split())
        with subtests.test(command):
            assert (result.code, result.out) == (code, ""), result.err
            assert result.err.startswith("league: ")
            assert result.err.count("\n") == 1
            assert message in result.err
            assert state() == before
