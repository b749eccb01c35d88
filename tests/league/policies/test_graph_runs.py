"""Runs of graphs end: after a time, or when they are told to."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from league.errors import DeadlineExceeded, GraphTimeout
from league.policies import graph_runs
from league.policies.onnx import OnnxPolicy
from tests.support.policies.graphs import endless_mlp, masked_mlp
from tests.support.waiting import until

ENDING = {"observation": np.zeros((3, 6, 7, 2), np.int8), "action_mask": np.ones((3, 7), np.int8)}
ENDLESS = ENDING | {"observation": np.ones((3, 6, 7, 2), np.int8)}


def test_a_run_ends_after_its_time() -> None:
    policy = OnnxPolicy(endless_mlp(), timeout=0.2)
    expected = OnnxPolicy(masked_mlp()).act(ENDING).actions
    for _ in range(2):
        assert policy.act(ENDING).actions.tolist() == expected.tolist()
        with pytest.raises(GraphTimeout, match=r"a run of the graph did not finish within 0.2 s"):
            policy.act(ENDLESS)
    with pytest.raises(DeadlineExceeded, match=r"within 0.1 s"):
        policy.within(0.1).distribution(ENDLESS)
    assert not graph_runs._runs


def test_runs_of_one_policy_are_ended() -> None:
    first, second, third = (OnnxPolicy(endless_mlp()).within(600, can_end=True) for _ in range(3))
    with ThreadPoolExecutor(3) as threads:
        running = {policy: threads.submit(policy.act, ENDLESS) for policy in (first, second, third)}
        until(lambda: len(graph_runs._runs) == 3)
        third.end_runs()
        with pytest.raises(GraphTimeout, match="was ended"):
            running[third].result()
        assert not running[first].done()
        assert not running[second].done()
        first.end_runs()
        second.end_runs()


def test_many_short_runs_are_not_ended() -> None:
    """Though a run of the policy is in progress all the time."""
    policy = OnnxPolicy(masked_mlp(), timeout=graph_runs.TURN)
    for _ in range(2000):
        policy.act(ENDING)
