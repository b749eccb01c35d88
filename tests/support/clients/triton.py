"""The unmodified `tritonclient`, in its four forms behind one interface."""

import asyncio
import atexit
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import tritonclient.grpc
import tritonclient.grpc.aio
import tritonclient.http
import tritonclient.http.aio
from numpy.typing import NDArray
from tritonclient.utils import np_to_triton_dtype

from tests.support.servers.protocol_servers import Address

KEPT: list[Any] = []
"""gevent clients fail if they are garbage-collected in another thread, and those of gRPC when the interpreter exits."""
atexit.register(KEPT.clear)
FORMS = ("http", "http.aio", "grpc", "grpc.aio")


class Triton:
    """One form of the client. Results are JSON documents and arrays for each transport."""

    def __init__(self, form: str, address: Address) -> None:
        self.is_http = form.startswith("http")
        self.is_async = form.endswith("aio")
        self.module: Any = tritonclient.http if self.is_http else tritonclient.grpc
        self._url = address.http if self.is_http else address.grpc
        self._loop = asyncio.new_event_loop() if self.is_async else None
        self._client = self._loop.run_until_complete(self._connect()) if self._loop else self._new()

    def __enter__(self) -> "Triton":
        return self

    def __exit__(self, *_: object) -> None:
        closed = self._client.close()
        KEPT.append(self._client)
        if self._loop is not None:
            self._loop.run_until_complete(closed)
            self._loop.close()

    def call(self, method: str, *arguments: Any, **options: Any) -> Any:
        """Call a method of the client."""
        answer = getattr(self._client, method)(*arguments, **options)
        return answer if self._loop is None else self._loop.run_until_complete(answer)

    def document(self, method: str, *arguments: Any) -> Any:
        """Call a method whose result is a JSON document over HTTP and a message over gRPC."""
        return self.call(method, *arguments) if self.is_http else self.call(method, *arguments, as_json=True)

    def infer(
        self,
        model: str,
        arrays: Mapping[str, NDArray],
        version: str = "",
        outputs: Sequence[str] | None = None,
        binary: bool = True,
        **options: Any,
    ) -> Any:
        """Infer; `binary` selects how tensors are encoded over HTTP, in both directions."""
        how = {"binary_data": binary} if self.is_http else {}
        inputs = []
        for name, array in arrays.items():
            tensor = self.module.InferInput(name, list(array.shape), np_to_triton_dtype(array.dtype))
            tensor.set_data_from_numpy(array, **how)
            inputs.append(tensor)
        requested = outputs and [self.module.InferRequestedOutput(name, **how) for name in outputs]
        return self.call("infer", model, inputs, model_version=version, outputs=requested, **options)

    def _new(self) -> Any:
        module = self.module.aio if self.is_async else self.module
        return module.InferenceServerClient(self._url)

    async def _connect(self) -> Any:
        return self._new()


def outputs_of(result: Any, names: Sequence[str]) -> dict[str, NDArray | None]:
    """Output name → array, None for missing outputs."""
    return {name: result.as_numpy(name) for name in names}


def assert_same(found: NDArray | None, expected: NDArray) -> None:
    assert found is not None
    assert found.dtype == expected.dtype
    np.testing.assert_array_equal(found, expected)
