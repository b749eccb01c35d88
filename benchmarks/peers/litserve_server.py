"""The policy on LitServe with one worker: `python litserve_server.py GRAPH PORT`."""

import sys
from typing import Any

import litserve
from graph_policy import GraphPolicy


class Policy(litserve.LitAPI):  # type: ignore[misc]
    """Answers the request body of our action endpoint."""

    def setup(self, device: str) -> None:  # noqa: ARG002
        """Load the graph in the worker."""
        self.policy = GraphPolicy(sys.argv[1])

    def decode_request(self, request: dict[str, Any]) -> dict[str, Any]:
        """Return the observation."""
        observation: dict[str, Any] = request["observation"]
        return observation

    def predict(self, observation: dict[str, Any]) -> int:
        """Return the action."""
        return self.policy.act(observation["observation"], observation["action_mask"])

    def encode_response(self, action: int) -> dict[str, int]:
        """Return the response body."""
        return {"action": action}


if __name__ == "__main__":
    server = litserve.LitServer(Policy(), accelerator="cpu", workers_per_device=1)
    server.run(
        host="127.0.0.1", port=int(sys.argv[2]), num_api_servers=1, generate_client_file=False, log_level="error"
    )
