"""The REST form of a request and a response: JSON, then the tensors that are binary, in the order of the JSON.

    Inference-Header-Content-Length: bytes of the JSON          (absent where nothing is binary)
    {"inputs": [{…, "parameters": {"binary_data_size": bytes}}, {…, "data": [ … ]}], "outputs": […]}  bytes  bytes …

Neither classification of outputs nor shared memory is offered.
"""

from typing import Any, NamedTuple

import numpy as np
import orjson

from league.errors import InvalidInput
from serve_app.bodies import parse_object
from serve_app.error_handlers import MalformedBody
from serve_app.inference_protocol.datatypes import datatype_of, to_bytes
from serve_app.inference_protocol.inference import InferRequest, InferResponse
from serve_app.inference_protocol.tensors import Tensor
from serve_app.observations import kind

SIZE = "binary_data_size"
SEQUENCE = "sequence_id"
UNAVAILABLE = ("shared_memory_region", "classification")
DUMP = orjson.OPT_SERIALIZE_NUMPY


class RestRequest(NamedTuple):
    """A request, with the outputs that are wanted in binary."""

    infer: InferRequest
    is_binary: bool
    """What holds for the outputs that `binary` does not name."""
    binary: dict[str, bool]


def read_request(model: str, version: str, body: bytes, header_length: int | None) -> RestRequest:
    """Read a body; `header_length` is that of its JSON, None if it is all JSON.

    Raises MalformedBody or InvalidInput.
    """
    document, rest = _split(body, header_length)
    parameters = _parameters(document, "the request")
    outputs = _list(document, "outputs", required=False)
    names, binary = [], {}
    for output in outputs:
        name = _string(output, "name", "an output")
        names.append(name)
        own = _parameters(output, "an output")
        if "binary_data" in own:
            binary[name] = _flag(own, "binary_data")
    request = InferRequest(
        model=model,
        version=version,
        id=_string(document, "id", "the request") if "id" in document else "",
        inputs=_tensors(_list(document, "inputs", required=True), rest),
        outputs=names,
        is_sequence=bool(parameters.get(SEQUENCE)),
    )
    is_binary = "binary_data_output" in parameters and _flag(parameters, "binary_data_output")
    return RestRequest(request, is_binary, binary)


def write_response(response: InferResponse, request: RestRequest) -> tuple[bytes, int | None]:
    """The body, and the length of its JSON if something follows that."""
    outputs, parts = [], []
    for name, array in response.outputs.items():
        output: dict[str, Any] = {"name": name, "datatype": datatype_of(array), "shape": array.shape}
        if request.binary.get(name, request.is_binary):
            parts.append(to_bytes(array))
            output["parameters"] = {SIZE: len(parts[-1])}
        else:
            output["data"] = np.ascontiguousarray(array).reshape(-1)
        outputs.append(output)
    document: dict[str, Any] = {"model_name": response.model, "model_version": response.version}
    if response.id:
        document["id"] = response.id
    head = orjson.dumps(document | {"outputs": outputs}, option=DUMP)
    return (b"".join((head, *parts)), len(head)) if parts else (head, None)


def _split(body: bytes, header_length: int | None) -> tuple[dict[str, Any], memoryview]:
    if header_length is None:
        return parse_object(body), memoryview(b"")
    if header_length > len(body):
        raise MalformedBody(f"Inference-Header-Content-Length is {header_length}, but the body has {len(body)} bytes")
    return parse_object(body[:header_length]), memoryview(body)[header_length:]


def _tensors(inputs: list[Any], rest: memoryview) -> list[Tensor]:
    tensors, begin = [], 0
    for document in inputs:
        name = _string(document, "name", "an input")
        shape = document.get("shape")
        if type(shape) is not list or not all(type(size) is int for size in shape):
            raise InvalidInput(f"the shape of input {name[:64]!r} is not a list of integers")
        size = _parameters(document, "an input").get(SIZE)
        data = document.get("data")
        if size is None:
            if type(data) is not list:
                raise InvalidInput(f"input {name[:64]!r} has neither {SIZE} nor a list as its data")
        elif type(size) is not int or size < 0 or data is not None:
            raise InvalidInput(f"{SIZE} of input {name[:64]!r} must be a number of bytes, without data beside it")
        else:
            data, begin = rest[begin : begin + size], begin + size
        tensors.append(Tensor(name, _string(document, "datatype", "an input"), shape, data))
    if begin != len(rest):
        raise InvalidInput(f"{len(rest)} bytes follow the JSON, but the inputs name {begin}")
    return tensors


def _list(document: dict[str, Any], key: str, required: bool) -> list[Any]:
    items = document.get(key)
    if items is None and not required:
        return []
    if type(items) is not list or not all(type(item) is dict for item in items):
        raise InvalidInput(f"{key} is {kind(items)}, expected a list of objects")
    return items


def _string(document: dict[str, Any], key: str, of: str) -> str:
    if type(text := document.get(key)) is not str:
        raise InvalidInput(f"the {key} of {of} is {kind(text)}, expected a string")
    return text


def _flag(parameters: dict[str, Any], key: str) -> bool:
    if type(flag := parameters[key]) is not bool:
        raise InvalidInput(f"{key} is {kind(flag)}, expected true or false")
    return flag


def _parameters(document: dict[str, Any], of: str) -> dict[str, Any]:
    parameters = document.get("parameters")
    if parameters is None:
        return {}
    if type(parameters) is not dict:
        raise InvalidInput(f"the parameters of {of} are {kind(parameters)}, expected an object")
    for name in UNAVAILABLE:
        if name in parameters:
            raise InvalidInput(f"{of} asks for {name}, which this server does not offer")
    return parameters
