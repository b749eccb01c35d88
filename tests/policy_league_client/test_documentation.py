"""The snippets on the pages of the client and of streams run as shown."""

import ast
import itertools
import re
import shutil
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml

from league.config.league import LeagueConfig
from league.environments.building import interface
from league.environments.external import advertisement
from league.environments.implementation import stock_stepping
from league.environments.stepping import BatchedEnvironment, each_agent_alone
from league.registry.gateways import ForSimulators
from league.registry.registry import Registry
from league.settings import Storage
from policy_league_client import simulator
from serve_app.inference.stream_codec import RESPONSE, encode_request
from tests.support.servers.streaming import connect_four_server, listening

ROOT = Path(__file__).parents[2]
URL = "http://127.0.0.1:8000"


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with connect_four_server(tmp_path_factory.mktemp("shown")) as server:
        yield server


def snippets(page: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", (ROOT / page).read_text(), flags=re.S | re.M)


@pytest.mark.parametrize("page", ["README.md", "docs/client.md", "docs/serving.md"])
def test_snippets_run_in_order(
    page: str, url: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    blocks = snippets(page, "python")
    names: dict[str, object] = {}
    for block in blocks:
        exec(compile(ast.parse(block.replace(URL, url)), page, "exec"), names)
        printed = capsys.readouterr().out
        assert ("print(" in block) == bool(printed), block
    assert blocks


def test_simulators_play_as_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The league is valid, and both programs play its episodes."""
    monkeypatch.setattr(simulator, "MAX_DELAY", 0.02)
    monkeypatch.setattr(advertisement, "INTERVAL", 0.02)
    page = "docs/simulators.md"
    config = LeagueConfig.from_mapping(yaml.safe_load(snippets(page, "yaml")[0]))
    registry = Registry.open(Storage.at(tmp_path))
    registry.leagues.register(config, interface(config))
    monkeypatch.setenv("LEAGUE_API_KEY", registry.keys.create("simulator", ["simulate"])[1])
    needs = ForSimulators(registry.storage, config.league)
    is_over = threading.Event()

    def play(environment: BatchedEnvironment) -> None:
        turn = environment.start(each_agent_alone(itertools.count(), 2))
        while not is_over.is_set():
            turn = environment.step({group: np.zeros(len(batch), np.int64) for group, batch in turn.batches.items()})

    with listening(registry.storage) as server:
        environment = stock_stepping(config.environment, 4, simulators=needs)
        threading.Thread(target=play, args=(environment,), daemon=True).start()
        names: dict[str, object] = {}
        for block in snippets(page, "python"):
            exec(compile(block.replace(URL, server.url), page, "exec"), names)
        is_over.set()


CHECK = """
#include <cstdio>
int main() {
    Bytes message = request({Bytes(168, 1), Bytes(14, 1)}, 2, true);
    std::fwrite(message.data(), 1, message.size(), stdout);
    Bytes answer(32, 0);
    answer[16] = 5;
    answer[24] = 6;
    std::vector<std::int64_t> found = actions(answer);
    return found.size() == 2 && found[0] == 5 && found[1] == 6 ? 0 : 1;
}
"""


@pytest.mark.skipif(shutil.which("g++") is None, reason="there is no C++ compiler")
def test_the_c_plus_plus_framing_is_ours(tmp_path: Path) -> None:
    (snippet,) = snippets("docs/stream.md", "cpp")
    (tmp_path / "shown.cpp").write_text(snippet + CHECK)
    command = ["g++", "-std=c++17", "-Wall", "-Werror", "shown.cpp", "-o", "shown"]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
    message = subprocess.run([tmp_path / "shown"], check=True, capture_output=True).stdout
    assert message == encode_request([np.ones((2, 84), np.int8), np.ones((2, 7), np.int8)], 2, reset=True)
    assert RESPONSE.size == 16
