"""Policies and interface for tests of self-play."""

from collections.abc import Mapping

import numpy as np
from hypothesis import strategies as st

from league.config.opponents import OpponentConfig
from tests.support.environments.scripted_environment import ACTIONS
from training.modules.policy_module import MASKED_LOGIT
from training.sampling.self_play import ForwardInput, ForwardOutput

INITIAL = {"policy_0": {"steps": np.zeros(1, np.float32)}, "policy_1": {}}

RANDOM = OpponentConfig(ref="script:random", share=0.5)

FRAGMENT_LENGTHS = st.lists(st.integers(1, 9), min_size=1, max_size=12)
"""Steps between two fragments."""


def forward(inputs: Mapping[str, ForwardInput]) -> dict[str, ForwardOutput]:
    """Logits that depend on the observation; the recurrent state counts the calls."""
    outputs = {}
    for policy, forward_input in inputs.items():
        observation = forward_input.observations["observation"]
        logits = np.sin(observation.sum(axis=1, keepdims=True) + np.arange(ACTIONS)).astype(np.float32)
        logits = np.where(forward_input.observations["action_mask"] != 0, logits, np.float32(MASKED_LOGIT))
        state = (
            {key: value + 1 for key, value in forward_input.state.items()} if forward_input.state is not None else None
        )
        outputs[policy] = ForwardOutput(logits, state)
    return outputs
