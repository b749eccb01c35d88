"""An exported version acts in a browser as it does in Python: the example of docs/exporting.md, as written."""

import re
import subprocess
import tempfile
from pathlib import Path
from shutil import which

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, Route

from league.policies.onnx import OnnxPolicy
from league.policies.probes import excused
from league.registry.registry import Registry
from league.registry.storage.exports import exported_files, write_files
from league.settings import Storage
from league.spaces import Discrete
from tests.support.leagues.served_leagues import BOARD, publish, register
from tests.support.policies.graphs import masked_mlp

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]
DOCS = Path(__file__).parents[2] / "docs" / "exporting.md"
PACKAGE = "onnxruntime-web@1.30.0"
ORIGIN = "https://page.test"
PAGE = """\
<!doctype html>
<script type="importmap">{"imports": {"onnxruntime-web": "/runtime/ort.wasm.min.mjs"}}</script>
<script type="module">import {act} from "/example.mjs"; window.act = act;</script>
"""
ROWS = 1000


@pytest.fixture(scope="module")
def runtime(request: pytest.FixtureRequest) -> Path:
    """The files of ONNX Runtime Web, which npm installs into pytest's cache."""
    npm = which("npm")
    if npm is None:
        pytest.skip("npm is not installed: it installs onnxruntime-web")
    assert request.config.cache is not None
    cache = request.config.cache.mkdir("npm")
    files = cache / PACKAGE
    if not files.is_dir():
        with tempfile.TemporaryDirectory(dir=cache) as partial:
            options = ("--prefix", partial, "--no-save", "--no-audit", "--no-fund", "--ignore-scripts")
            network = ("--fetch-timeout=60000", "--fetch-retries=1")
            done = subprocess.run([npm, "install", *options, *network, PACKAGE], capture_output=True, text=True)
            if done.returncode:
                pytest.skip(f"npm cannot install {PACKAGE}: {done.stderr.strip()[-300:]}")
            (Path(partial) / "node_modules" / "onnxruntime-web" / "dist").rename(files)
    return files


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A version with the spaces of connect four."""
    registry = Registry.open(Storage.at(tmp_path_factory.mktemp("home")))
    register(registry, "board", {"shared": BOARD})
    publish(registry, "board", {"shared": masked_mlp(hidden=(64, 64))}, "run/1")
    target = tmp_path_factory.mktemp("exported") / "files"
    write_files(exported_files(registry.versions.get("board", 1), registry.artifacts), target)
    registry.close()
    return target


@pytest.fixture
def page(browser: Browser, exported: Path, runtime: Path) -> Page:
    """A page with the example of the documentation."""
    (example,) = re.findall(r"```js\n(.*?)```", DOCS.read_text(), re.DOTALL)

    def answer(route: Route) -> None:
        path = route.request.url.removeprefix(ORIGIN)
        if path.startswith("/runtime/"):
            route.fulfill(path=runtime / path.removeprefix("/runtime/"))
        elif path.endswith(".onnx"):
            route.fulfill(path=exported / path.removeprefix("/"))
        elif path == "/example.mjs":
            route.fulfill(body=example, content_type="text/javascript")
        else:
            route.fulfill(body=PAGE, content_type="text/html")

    opened = browser.new_page()
    opened.route(f"{ORIGIN}/**", answer)
    opened.goto(f"{ORIGIN}/")
    opened.wait_for_function("window.act !== undefined", timeout=300_000)
    return opened


def test_the_example_acts_as_the_graph_does_in_python(page: Page, exported: Path) -> None:
    rng = np.random.default_rng(0)
    boards = rng.integers(0, 2, (ROWS, 6, 7, 2), dtype=np.int8)
    masks = rng.integers(0, 2, (ROWS, 7), dtype=np.int8)
    masks[np.arange(ROWS), rng.integers(0, 7, ROWS)] = 1
    sent = [boards.ravel().tolist(), masks.ravel().tolist()]
    actions = page.evaluate("([boards, masks]) => act(new Int8Array(boards), new Int8Array(masks))", sent)
    expected = OnnxPolicy(exported / "shared.onnx").distribution({"observation": boards, "action_mask": masks})
    assert expected.dist_inputs is not None
    assert excused(np.array(actions), expected.actions, expected.dist_inputs, Discrete(n=7)).all()
    assert len(set(actions)) == 7
