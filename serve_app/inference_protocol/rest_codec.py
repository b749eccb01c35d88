"""Encodes REST bodies of the protocol: JSON with optional binary tensors.

    Inference-Header-Content-Length: length of the JSON         (absent without binary tensors)
    {"inputs": [{…, "parameters": {"binary_data_size": size}}, {…, "data": [ … ]}], "outputs": […]}  bytes  bytes …

An optional field may be null, as serialisers of Java and C# write it. Classification and shared memory are not
supported.
"""

from typing import Any, NamedTuple

import numpy as np
import orjson

from league.errors import InvalidInput
from league.spaces.observation_codec import json_type
from serve_app.access.errors import MalformedBody
from serve_app.access.request_body import parse_json_object
from serve_app.inference_protocol.inference import InferRequest, Outputs
from serve_app.inference_protocol.tensors import RequestTensor, datatype_of, to_bytes

SIZE = "binary_data_size"
SEQUENCE = "sequence_id"
UNSUPPORTED = ("shared_memory_region", "classification")
DUMP = orjson.OPT_SERIALIZE_NUMPY


class RestRequest(NamedTuple):
    """A request, with the outputs to send as binary data."""

    infer: InferRequest
    is_binary: bool
    """Default for outputs that are not in `binary`."""
    binary: dict[str, bool]


def read_request(body: bytes, header_length: int | None) -> RestRequest:
    """Decode a body; `header_length` is the length of its JSON, None if it is all JSON.

    Raises MalformedBody or InvalidInput.
    """
    if header_length is not None and header_length > len(body):
        raise MalformedBody(f"Inference-Header-Content-Length is {header_length}, but the body has {len(body)} bytes")
    document = parse_json_object(body[:header_length])
    tensor_bytes = memoryview(b"" if header_length is None else body)[header_length or 0 :]
    parameters = _parameters(document, "the request")
    outputs = _list(document, "outputs", required=False)
    names, binary = [], {}
    for output in outputs:
        name = _string(output, "name", "an output")
        names.append(name)
        output_parameters = _parameters(output, "an output")
        if output_parameters.get("binary_data") is not None:
            binary[name] = _flag(output_parameters, "binary_data")
    request = InferRequest(
        id="" if document.get("id") is None else _string(document, "id", "the request"),
        inputs=_tensors(_list(document, "inputs", required=True), tensor_bytes),
        outputs=names,
        size=len(body),
        is_sequence=bool(parameters.get(SEQUENCE)),
    )
    is_binary = parameters.get("binary_data_output") is not None and _flag(parameters, "binary_data_output")
    return RestRequest(request, is_binary, binary)


def write_response(model: str, version: int, arrays: Outputs, request: RestRequest) -> tuple[bytes, int | None]:
    """Encode a response; returns the body, and the length of its JSON if binary data follows."""
    outputs, parts = [], []
    for name, array in arrays.items():
        output: dict[str, Any] = {"name": name, "datatype": datatype_of(array), "shape": array.shape}
        if request.binary.get(name, request.is_binary):
            parts.append(to_bytes(array))
            output["parameters"] = {SIZE: len(parts[-1])}
        else:
            output["data"] = np.ascontiguousarray(array).reshape(-1)
        outputs.append(output)
    document: dict[str, Any] = {"model_name": model, "model_version": str(version)}
    if request.infer.id:
        document["id"] = request.infer.id
    head = orjson.dumps(document | {"outputs": outputs}, option=DUMP)
    return (b"".join((head, *parts)), len(head)) if parts else (head, None)


def _tensors(inputs: list[Any], rest: memoryview) -> list[RequestTensor]:
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
            raise InvalidInput(f"{SIZE} of input {name[:64]!r} must be a number of bytes, and data must be absent")
        else:
            data, begin = rest[begin : begin + size], begin + size
        tensors.append(RequestTensor(name, _string(document, "datatype", "an input"), shape, data))
    if begin != len(rest):
        raise InvalidInput(f"{len(rest)} bytes follow the JSON, but the inputs declare {begin}")
    return tensors


def _list(document: dict[str, Any], key: str, required: bool) -> list[Any]:
    items = document.get(key)
    if items is None and not required:
        return []
    if type(items) is not list or not all(type(item) is dict for item in items):
        raise InvalidInput(f"{key} is {json_type(items)}, expected a list of objects")
    return items


def _string(document: dict[str, Any], key: str, of: str) -> str:
    if type(text := document.get(key)) is not str:
        raise InvalidInput(f"the {key} of {of} is {json_type(text)}, expected a string")
    return text


def _flag(parameters: dict[str, Any], key: str) -> bool:
    if type(flag := parameters[key]) is not bool:
        raise InvalidInput(f"{key} is {json_type(flag)}, expected true or false")
    return flag


def _parameters(document: dict[str, Any], of: str) -> dict[str, Any]:
    parameters = document.get("parameters")
    if parameters is None:
        return {}
    if type(parameters) is not dict:
        raise InvalidInput(f"the parameters of {of} are {json_type(parameters)}, expected an object")
    for name in UNSUPPORTED:
        if parameters.get(name) is not None:
            raise InvalidInput(f"{of} requests {name}, which this server does not support")
    return parameters
