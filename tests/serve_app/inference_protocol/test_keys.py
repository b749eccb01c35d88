"""API keys on both protocols, shown by the stock client as a header or as a call's metadata."""

from collections.abc import Iterator

import numpy as np
import pytest
from tritonclient.utils import InferenceServerException

from league.registry.registry import Registry
from league.settings import Storage
from serve_app.app import Server
from tests.serve_app.inference_protocol.conftest import SETTINGS, InProcess, Listening
from tests.serve_app.inference_protocol.triton import FORMS, Triton
from tests.serve_app.leagues import everything

VECTOR = {"observation": np.zeros((1, 2), np.float32)}
STATUS = {
    "unknown": {True: "401", False: "StatusCode.UNAUTHENTICATED"},
    "wrong": {True: "403", False: "StatusCode.PERMISSION_DENIED"},
}


@pytest.fixture(scope="module")
def locked(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[InProcess, dict[str, str]]]:
    """A replica that asks for keys, and the text of one for each scope."""
    registry = everything(Storage.at(tmp_path_factory.mktemp("locked")))
    tokens = {scope: registry.create_key(scope, [scope])[1] for scope in ("act", "read")}
    with Listening(Server(Registry.open(registry.storage), SETTINGS, "replica-1")) as address:
        yield address, tokens
    registry.close()


@pytest.mark.parametrize("form", FORMS)
def test_a_key_opens_what_its_scope_says(locked: tuple[InProcess, dict[str, str]], form: str) -> None:
    address, tokens = locked
    acts, reads = ({"authorization": f"Bearer {tokens[scope]}"} for scope in ("act", "read"))
    with Triton(form, address) as triton:

        def refused(why: str, call: str, *arguments: object, **options: object) -> None:
            with pytest.raises(InferenceServerException) as caught:
                (triton.infer if call == "infer" else triton.ask)(*arguments, **options)  # type: ignore[operator]
            assert caught.value.status() == STATUS[why][triton.is_http]

        assert triton.infer("vector", VECTOR, headers=acts).as_numpy("action") is not None
        assert triton.ask("get_model_metadata", "vector", headers=reads)
        assert triton.ask("is_server_ready")
        refused("unknown", "infer", "vector", VECTOR)
        refused("unknown", "infer", "vector", VECTOR, headers={"authorization": f"Bearer {tokens['act'][:-1]}x"})
        refused("wrong", "infer", "vector", VECTOR, headers=reads)
        refused("unknown", "get_model_metadata", "get_model_metadata", "vector")
        refused("wrong", "get_model_repository_index", "get_model_repository_index", headers=acts)
