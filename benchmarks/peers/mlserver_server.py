"""The policy on MLServer with one worker: a runtime whose `uri` is the graph. Requests follow the Open Inference
Protocol."""

from graph_policy import GraphPolicy
from mlserver import MLModel
from mlserver.codecs import NumpyCodec
from mlserver.types import InferenceRequest, InferenceResponse, ResponseOutput


class Policy(MLModel):  # type: ignore[misc]
    """Expects the board and the mask as the first two inputs."""

    async def load(self) -> bool:
        """Load the graph."""
        self.policy = GraphPolicy(self.settings.parameters.uri)
        return True

    async def predict(self, payload: InferenceRequest) -> InferenceResponse:
        """Return the action."""
        board, mask = (NumpyCodec.decode_input(tensor) for tensor in payload.inputs)
        action = self.policy.act(board, mask)
        output = ResponseOutput(name="action", shape=[1], datatype="INT64", data=[action])
        return InferenceResponse(model_name=self.name, outputs=[output])
