"""The gRPC form of a request and a response: tensors as bytes, or as numbers in the field of their datatype."""

from league.errors import InvalidInput
from serve_app.inference_protocol import open_inference_pb2 as messages
from serve_app.inference_protocol.datatypes import datatype_of, to_bytes
from serve_app.inference_protocol.framing import SEQUENCE, UNAVAILABLE
from serve_app.inference_protocol.inference import InferRequest, InferResponse
from serve_app.inference_protocol.tensors import Data, Tensor

CONTENTS = {
    "BOOL": "bool_contents",
    "INT8": "int_contents",
    "INT16": "int_contents",
    "INT32": "int_contents",
    "INT64": "int64_contents",
    "UINT8": "uint_contents",
    "UINT16": "uint_contents",
    "UINT32": "uint_contents",
    "UINT64": "uint64_contents",
    "FP32": "fp32_contents",
    "FP64": "fp64_contents",
}
"""The field that holds a datatype's elements where they do not come as bytes. FP16 has none."""


def read_request(request: messages.ModelInferRequest) -> InferRequest:
    """A call's message → what is asked. Raises InvalidInput."""
    for asked in (*request.inputs, *request.outputs):
        for name in UNAVAILABLE:
            if name in asked.parameters:
                raise InvalidInput(f"{asked.name[:64]!r} asks for {name}, which this server does not offer")
    raw_inputs = request.raw_input_contents
    if raw_inputs and len(raw_inputs) != len(request.inputs):
        raise InvalidInput(f"{len(raw_inputs)} raw_input_contents for {len(request.inputs)} inputs, expected one each")
    sequence = request.parameters.get(SEQUENCE)
    return InferRequest(
        model=request.model_name,
        version=request.model_version,
        id=request.id,
        inputs=[_tensor(tensor, raw_inputs[i] if raw_inputs else None) for i, tensor in enumerate(request.inputs)],
        outputs=[output.name for output in request.outputs],
        is_sequence=sequence is not None and bool(sequence.int64_param or sequence.string_param),
    )


def _tensor(tensor: messages.ModelInferRequest.InferInputTensor, contents: bytes | None) -> Tensor:
    data: Data
    if contents is not None:
        if tensor.HasField("contents"):
            raise InvalidInput(f"input {tensor.name[:64]!r} has contents as well as raw_input_contents")
        data = contents
    elif (field := CONTENTS.get(tensor.datatype)) is not None:
        data = list(getattr(tensor.contents, field))
    else:
        raise InvalidInput(f"input {tensor.name[:64]!r} has datatype {tensor.datatype[:64]!r}: send it as bytes")
    return Tensor(tensor.name, tensor.datatype, tensor.shape, data)


def write_response(response: InferResponse) -> messages.ModelInferResponse:
    """What is answered → a call's message: every output as bytes."""
    outputs = response.outputs
    return messages.ModelInferResponse(
        model_name=response.model,
        model_version=response.version,
        id=response.id,
        outputs=[
            messages.ModelInferResponse.InferOutputTensor(name=name, datatype=datatype_of(array), shape=array.shape)
            for name, array in outputs.items()
        ],
        raw_output_contents=[to_bytes(array) for array in outputs.values()],
    )
