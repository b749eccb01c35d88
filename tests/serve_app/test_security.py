"""Content of checkpoints and requests is never executed: traps of each kind are served and sent, and none is triggered.

CPython reports lookups of unpicklers and new processes to an audit hook (PEP 578).
"""

import asyncio
import base64
import gzip
import hashlib
import io
import os
import pickle
import shutil
import sys
import tarfile
import threading
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper
from sqlalchemy import update
from starlette.testclient import TestClient

from league.errors import ArtifactCorrupt, LeagueError
from league.registry.registry import Registry
from league.registry.storage.manifest import MANIFEST, Manifest
from league.registry.storage.tables import VersionTable
from serve_app.inference.stream_codec import FRAMING, REQUEST
from serve_app.live_versions import version_cache
from serve_app.live_versions.policies import ActionSelections
from tests.support.clients.actions import BOARD
from tests.support.leagues.served_leagues import publish
from tests.support.policies.graphs import masked_mlp
from tests.support.policies.probes import probes

SUSPICIOUS = frozenset(("pickle.find_class", "os.system", "os.exec", "subprocess.Popen", "os.posix_spawn"))


GRAPH, PROBES = "shared.onnx", "shared.probes.npz"
LIMIT = 2**20
"""Maximum size of decompressed probes."""
_watched: list[str] | None = None
_threads: set[threading.Thread] = set()
"""That of the test, those that it has started, and so on. Ray's and those of other replicas may unpickle."""


def _hook(event: str, arguments: tuple[object, ...]) -> None:
    if _watched is not None and event in SUSPICIOUS and threading.current_thread() in _threads:
        _watched.append(f"{event}{arguments}")


sys.addaudithook(_hook)


@pytest.fixture(autouse=True)
def _followed_threads(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Add the threads of the test to `_threads`. It comes before `client`, which starts the replica's."""
    start = threading.Thread.start

    def follow(thread: threading.Thread) -> None:
        if threading.current_thread() in _threads:
            _threads.add(thread)
        start(thread)

    _threads.add(threading.current_thread())
    monkeypatch.setattr(threading.Thread, "start", follow)
    yield
    _threads.clear()


@contextmanager
def nothing_executed() -> Iterator[None]:
    """Fail if anything is unpickled, or any process is started, while the context lasts."""
    global _watched
    _watched = []
    try:
        yield
        assert _watched == []
    finally:
        _watched = None


class Trap:
    """Creates a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Callable[[str], int], tuple[str]]:
        return os.system, (f"touch {self.path}",)


@pytest.fixture
def mark(tmp_path: Path) -> Path:
    return tmp_path / "sprung"


@pytest.fixture
def trap(mark: Path) -> bytes:
    """A pickle that triggers the trap when it is loaded."""
    return pickle.dumps(Trap(mark))


def test_loading_the_pickle_triggers_the_trap(client: TestClient, trap: bytes, mark: Path) -> None:
    assert client.portal is not None
    for load in (pickle.loads, partial(client.portal.call, asyncio.to_thread, pickle.loads)):  # a thread of the replica
        with pytest.raises(AssertionError, match=r"pickle\.find_class"), nothing_executed():
            load(trap)
        assert mark.exists()
        mark.unlink()


def torch_checkpoint(trap: bytes) -> bytes:
    """The format of `torch.load`: a ZIP file with a pickle."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("archive/data.pkl", trap)
        archive.writestr("archive/version", b"3\n")
    return buffer.getvalue()


def tar_bomb(trap: bytes) -> bytes:
    """A small file that unpacks to a large one, with paths outside the directory."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as archive:
        for name, content in (("../../outside", trap), ("zeros", bytes(2**20))):
            info = tarfile.TarInfo(name)
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))
    return buffer.getvalue()


def outside_weights(path: Path) -> bytes:
    """A graph with external weights."""
    model = onnx.load_from_string(masked_mlp(seed=0))
    for tensor in model.graph.initializer:
        tensor.ClearField("raw_data")
        tensor.data_location = TensorProto.EXTERNAL
        for key, value in (("location", str(path)), ("offset", "0"), ("length", "16")):
            tensor.external_data.add(key=key, value=value)
    return model.SerializeToString()


def foreign_operator(path: Path) -> bytes:
    """A graph with an operator of a Python library."""
    model = onnx.load_from_string(masked_mlp(seed=0))
    model.graph.node.append(
        helper.make_node("PyOp", [model.graph.output[0].name], ["more"], domain="ai.onnx.contrib", code=str(path))
    )
    model.opset_import.append(helper.make_opsetid("ai.onnx.contrib", 1))
    return model.SerializeToString()


def pickled_array(trap: bytes) -> bytes:
    """An array of objects in NumPy's format: a header and a pickle."""
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(buffer, {"descr": "|O", "fortran_order": False, "shape": (1,)})
    return buffer.getvalue() + trap


def archive(content: bytes, name: str = "action.npy") -> bytes:
    """An archive of arrays in NumPy's format."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as entries:
        entries.writestr(name, content)
    return buffer.getvalue()


def damaged(content: bytes) -> bytes:
    """Bytes that a decompressor rejects."""
    return content[:60] + b"\xff" * 20 + content[80:]


FILES: dict[tuple[str, str], Callable[[bytes, Path], bytes]] = {
    (GRAPH, "a pickle"): lambda trap, _: trap,
    (GRAPH, "a checkpoint of torch"): lambda trap, _: torch_checkpoint(trap),
    (GRAPH, "an archive"): lambda trap, _: tar_bomb(trap),
    (GRAPH, "compressed zeros"): lambda _, __: gzip.compress(bytes(2**20)),
    (GRAPH, "weights in another file"): lambda _, mark: outside_weights(mark),
    (GRAPH, "weights in a relative path"): lambda _, mark: outside_weights(Path("..") / ".." / mark.name),
    (GRAPH, "an operator of Python"): lambda _, mark: foreign_operator(mark),
    (GRAPH, "nothing"): lambda _, __: b"",
    (PROBES, "a pickle"): lambda trap, _: trap,
    (PROBES, "an array of objects"): lambda trap, _: pickled_array(trap),
    (PROBES, "an archive with an array of objects"): lambda trap, _: archive(pickled_array(trap)),
    (PROBES, "an archive with a pickle"): lambda trap, _: archive(trap),
    (PROBES, "an archive with a pickle of another name"): lambda trap, _: archive(trap, "action.pkl"),
    (PROBES, "a checkpoint of torch"): lambda trap, _: torch_checkpoint(trap),
    (PROBES, "a damaged archive"): lambda trap, _: damaged(archive(pickled_array(trap) + os.urandom(1000))),
    (PROBES, "an archive of zeros"): lambda _, __: archive(bytes(2 * LIMIT)),
}


def load(registry: Registry, number: int) -> None:
    """Load a version, as a replica does."""
    version_cache.load(registry, "board", number, 0.001, ActionSelections())


def test_a_malicious_file_is_rejected(
    registry: Registry, trap: bytes, mark: Path, monkeypatch: pytest.MonkeyPatch, subtests: pytest.Subtests
) -> None:
    """Published with correct digests, as by an attacker who may publish."""
    monkeypatch.setattr("league.policies.probes.MAX_SIZE", LIMIT)
    version = publish(registry, "board", {"shared": masked_mlp(seed=0)}, "run/trap", {"shared": probes()})
    directory = registry.artifacts.path("board", version.number)
    valid = {name: (directory / name).read_bytes() for name in (GRAPH, PROBES)}
    for (name, kind), create in FILES.items():
        replace_version(registry, version.number, version.manifest, valid | {name: create(trap, mark)})
        message = "contains no probes" if name == PROBES else ""
        with subtests.test(name, kind=kind), nothing_executed(), pytest.raises(ArtifactCorrupt, match=message):
            load(registry, version.number)
        assert not mark.exists()
    replace_version(registry, version.number, version.manifest, valid)
    load(registry, version.number)
    (directory / "weights.pkl").write_bytes(trap)
    with nothing_executed(), pytest.raises(ArtifactCorrupt, match=f"does not belong to board@{version.number}"):
        load(registry, version.number)
    assert not mark.exists()


def test_a_manifest_with_other_paths_is_rejected(registry: Registry, subtests: pytest.Subtests) -> None:
    version = publish(registry, "board", {"shared": masked_mlp(seed=1)}, "run/trap")
    (registry.artifacts.root / "outside").write_bytes(b"not this league's")
    policy, files = version.manifest.policies["shared"], version.manifest.files
    changes: list[dict[str, Any]] = [
        {"policies": {"shared": policy.model_copy(update={"file": name})}}
        for name in ("../2/shared.onnx", "/etc/passwd", "missing.onnx", ".", "", "shared.onnx/x")
    ]
    changes += [{"files": files | {name: "0" * 64}} for name in ("../../outside", "/etc/passwd")]
    for change in changes:
        replace_version(registry, version.number, version.manifest.model_copy(update=change), {})
        message = "is missing" if "files" in change else ""
        with subtests.test(change=change), pytest.raises(LeagueError, match=message):
            load(registry, version.number)


def as_symbolic_link(path: Path) -> None:
    secret = path.parent.parent / "secret"
    secret.write_text("somebody else's")
    path.symlink_to(secret)


def test_a_special_file_is_rejected_without_blocking(registry: Registry, subtests: pytest.Subtests) -> None:
    directory = registry.artifacts.path("board", 3)
    valid = shutil.copytree(directory, directory.with_name("valid"))
    for name in (GRAPH, MANIFEST):
        for replace in (as_symbolic_link, os.mkfifo, Path.mkdir, lambda path: path.symlink_to("/dev/zero"), Path.touch):
            (directory / name).unlink()
            replace(directory / name)
            with subtests.test(name, replace=replace), pytest.raises(LeagueError):
                load(registry, 3)
            shutil.rmtree(directory)
            with subtests.test("no directory"), pytest.raises(LeagueError):
                load(registry, 3)
            shutil.copytree(valid, directory)
    load(registry, 3)


TYPES = ("application/json", "application/octet-stream", "application/x-pickle")
PATHS = ("/v1/policies/board/action", "/v2/models/board/infer", "/v2/repository/index", "/v1/leagues/board/rollback")


def test_a_malicious_request_is_rejected(client: TestClient, registry: Registry, trap: bytes, mark: Path) -> None:
    _, token = registry.keys.create("all", ["act", "read", "promote"])
    text = base64.b64encode(trap).decode()
    bodies: list[bytes] = [
        trap,
        zlib.compress(trap),
        text.encode(),
        b'{"observation": "%s"}' % text.encode(),
        b'{"observation": {"__reduce__": ["os.system", ["touch %s"]]}}' % str(mark).encode(),
        b'{"py/object": "os.system", "py/reduce": ["touch %s"]}' % str(mark).encode(),
        b'{"inputs": [{"name": "observation", "shape": [1], "datatype": "BYTES", "data": ["%s"]}]}' % text.encode(),
        b'{"observation": {"b64": "%s", "dtype": "object", "shape": [1]}}' % text.encode(),
        *(
            b'{"observation": {"observation": {"%s": "%s"}, "action_mask": [1, 1, 1, 1, 1, 1, 1]}}' % (key, encoded)
            for key in (b"b64", b"png")
            for encoded in map(base64.b64encode, (trap, pickled_array(trap), archive(pickled_array(trap))))
        ),
        b'{"observation": [1], "state": "%s"}' % base64.urlsafe_b64encode(trap).rstrip(b"="),
        b'{"observation": [1], "state": {"state_in_0": "%s"}}' % text.encode(),
        b"!!python/object/apply:os.system ['touch %s']" % str(mark).encode(),
    ]
    client.headers.update({"x-api-key": token, "idempotency-key": "a"})
    bomb = zlib.compress(bytes(2**20), 9)
    requests = [(body, {"content-type": kind}) for body in bodies for kind in TYPES]
    with nothing_executed():
        for path in PATHS:
            for body, headers in (*requests, (bomb, {"content-encoding": "deflate"})):
                reply = client.post(path, content=body, headers=headers)
                assert 400 <= reply.status_code < 500, reply.text
    assert not mark.exists()
    reply = client.post("/v1/policies/board/action", json={"observation": BOARD})
    assert reply.json()["version"] == 1


def test_a_malicious_message_of_a_stream_is_rejected(client: TestClient, trap: bytes, mark: Path) -> None:
    text = base64.b64encode(trap).decode()
    with nothing_executed(), client.websocket_connect("/v1/policies/memory/stream") as stream:
        for data in (trap, REQUEST.pack(FRAMING, 0, 0, 1, 0) + trap, pickled_array(trap), archive(pickled_array(trap))):
            stream.send_bytes(data)
            assert stream.receive_json()["status"] == 400
        for document in ({"observation": text}, {"observation": {"b64": text}}, {"observation": [1], "state": text}):
            stream.send_json(document)
            assert stream.receive_json()["status"] == 400
    assert not mark.exists()


def replace_version(registry: Registry, number: int, manifest: Manifest, files: dict[str, bytes]) -> None:
    """Replace published files with correct digests, in the store and in the database."""
    directory = registry.artifacts.path(manifest.league, number)
    for name, content in files.items():
        (directory / name).write_bytes(content)
    digests = manifest.files | {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
    text = manifest.model_copy(update={"files": digests}).to_json()
    (directory / MANIFEST).write_text(text)
    with registry.database.write() as session:
        values = {"manifest": text, "sha256": hashlib.sha256(text.encode()).hexdigest()}
        session.execute(update(VersionTable).filter_by(league=manifest.league, number=number).values(values))
