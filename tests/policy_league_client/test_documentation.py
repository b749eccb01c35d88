"""The snippets on the pages of the client and of streams run as shown."""

import ast
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from league.registry.registry import Registry
from league.settings import Storage
from serve_app.inference.stream_codec import RESPONSE, encode_request
from tests.support.leagues.served_leagues import BOARD, promote, publish, register
from tests.support.policies.graphs import masked_mlp
from tests.support.servers.streaming import listening

ROOT = Path(__file__).parents[2]
URL = "http://127.0.0.1:8000"


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    registry = Registry.open(Storage.at(tmp_path_factory.mktemp("shown")))
    register(registry, "connect_four", {"shared": BOARD})
    publish(registry, "connect_four", {"shared": masked_mlp()}, "run")
    promote(registry, "connect_four", 1)
    with listening(registry.storage) as listener:
        yield listener.url
    registry.close()


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
