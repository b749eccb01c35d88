"""Executes inference requests of the protocol, over REST and gRPC: resolves the policy, checks inputs, runs the
graph."""

from collections.abc import Callable, Sequence
from time import perf_counter_ns
from typing import NamedTuple, TypeVar

from numpy.typing import NDArray

from league.errors import InvalidInput
from league.policies.onnx import ACTION, DIST_INPUTS, STATE_IN, STATE_OUT
from league.refs import CHAMPION
from serve_app.codecs.request_limits import LARGE_BODY
from serve_app.inference.batches import Answer
from serve_app.inference.serving import Serving
from serve_app.inference.stream_codec import BinaryObservations
from serve_app.inference_protocol.statistics import Statistics
from serve_app.inference_protocol.tensors import RequestTensor, checked_inputs
from serve_app.live_versions.policies import ActionOptions, LoadedPolicy
from serve_app.live_versions.traffic_split import Headers

T = TypeVar("T")
Outputs = dict[str, NDArray]
API = "infer"
"""Name of inference requests in metrics."""


GREEDY, WITH_LOGITS = ActionOptions(explore=False), ActionOptions(explore=False, values="outputs")
"""How actions are chosen: always greedily."""


class InferRequest(NamedTuple):
    """An inference request."""

    id: str
    inputs: Sequence[RequestTensor]
    outputs: Sequence[str]
    """Names of the requested outputs; all if empty."""
    size: int
    """Bytes of the request."""
    is_sequence: bool = False
    """Whether the client expects the server to keep state between requests."""


class Inference:
    """Executes inference requests of a replica. Runs on the event loop."""

    def __init__(self, serving: Serving) -> None:
        self.serving = serving
        self.statistics = Statistics()

    async def find(self, model: str, version: str, headers: Headers = ()) -> LoadedPolicy:
        """The policy that answers for a model. Raises the errors of `ModelResolver.find`."""
        return await self.serving.models.find(model, version or CHAMPION, headers)

    async def infer(
        self,
        policy: LoadedPolicy,
        request: InferRequest,
        encode: Callable[[Outputs], T],
        begun: int,
        inputs: BinaryObservations | None = None,
    ) -> T:
        """Execute a request and encode the response.

        Args:
            policy: The policy that answers.
            request: The request.
            encode: Makes the response from the outputs, in the requested order.
            begun: When the request began, a time of `perf_counter_ns`.
            inputs: The inputs of the request if they are known to be those of the policy.

        Raises:
            LeagueError: The inputs or outputs are not those of the policy, or the graph fails.
        """
        entry = self.statistics.entry(policy.model, policy.number)
        try:
            output_names = wanted_outputs(request.outputs, policy)
            if request.is_sequence and policy.state:
                raise InvalidInput("sequences are not supported: send state_out_<i> back as state_in_<i>")
            observations = inputs or checked_inputs(
                request.inputs, policy, self.serving.settings.max_batch, request.size > LARGE_BODY
            )
            options = WITH_LOGITS if DIST_INPUTS in output_names else GREEDY
            answer = await self.serving.act(policy, observations, options)
            encoded = encode({name: output_of(name, answer) for name in output_names})
        except BaseException:
            entry.fail(perf_counter_ns() - begun)
            raise
        rows, done = observations.rows, perf_counter_ns()
        entry.succeed(rows, begun, answer.started, answer.read, answer.ran, done, answer.runs)
        self.serving.metrics.count_request(API, policy, rows, begun)
        return encoded


def wanted_outputs(outputs: Sequence[str], policy: LoadedPolicy) -> Sequence[str]:
    """Names of the requested outputs. Raises InvalidInput."""
    if not outputs:
        return list(policy.outputs)
    for name in outputs:
        if name not in policy.outputs:
            raise InvalidInput(f"unknown output {name[:64]!r}, expected {', '.join(policy.outputs)}")
    if len(set(outputs)) < len(outputs):
        raise InvalidInput("an output is requested twice")
    return outputs


def output_of(name: str, answer: Answer) -> NDArray:
    """The output of a graph by its name in the protocol."""
    if name == ACTION:
        return answer.actions
    if name == DIST_INPUTS:
        assert answer.dist_inputs is not None
        return answer.dist_inputs
    assert answer.output.state is not None
    return answer.output.state[STATE_IN + name.removeprefix(STATE_OUT)]
