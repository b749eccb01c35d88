"""The policy on BentoML with one worker: `PEER_GRAPH=GRAPH bentoml serve bentoml_server:Policy`."""

import os
from typing import Any

import bentoml
from graph_policy import GraphPolicy


@bentoml.service(workers=1)  # type: ignore[misc]
class Policy:
    """Answers the request body of our action endpoint."""

    def __init__(self) -> None:
        self.policy = GraphPolicy(os.environ["PEER_GRAPH"])

    @bentoml.api(route="/act")  # type: ignore[misc]
    def act(self, observation: dict[str, Any]) -> dict[str, int]:
        """Return the action."""
        return {"action": self.policy.act(observation["observation"], observation["action_mask"])}
