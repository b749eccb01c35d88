"""Runs of graphs end after a time."""

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from threading import Event, Semaphore

import numpy as np
import pytest

from league.errors import GraphTimeout
from league.policies import graph_runs
from league.policies.onnx import OnnxPolicy
from league.policies.policy import Actions
from tests.support.policies.graphs import endless_mlp, masked_mlp
from tests.support.waiting import until

ENDING = {"observation": np.zeros((3, 6, 7, 2), np.int8), "action_mask": np.ones((3, 7), np.int8)}
ENDLESS = ENDING | {"observation": np.ones((3, 6, 7, 2), np.int8)}


@pytest.fixture
def take_turn() -> Iterator[Callable[[], None]]:
    """Lets the thread that ends runs take a turn. By itself it takes none: while it does, a busy machine may give a
    short run no time.
    """
    asleep, awake = Semaphore(0), Semaphore(0)

    def sleep(_: float) -> None:
        asleep.release()
        awake.acquire()

    def take() -> None:
        awake.release()
        asleep.acquire()

    graph_runs.open_session(masked_mlp())  # starts the thread
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(graph_runs, "sleep", sleep)
        asleep.acquire()
        yield take
    awake.release()


def test_a_run_ends_after_its_time(take_turn: Callable[[], None]) -> None:
    policy = OnnxPolicy(endless_mlp(), timeout=0.2)
    expected = OnnxPolicy(masked_mlp()).act(ENDING).actions
    thread = ThreadPoolExecutor(1)

    def has_ended(run: Future[Actions]) -> bool:
        take_turn()
        return run.done()

    for seconds, act in ((0.2, policy.act), (0.2, policy.act), (0.1, policy.within(0.1).distribution)):
        assert policy.act(ENDING).actions.tolist() == expected.tolist()
        turn = graph_runs._turn
        run = thread.submit(act, ENDLESS)
        until(partial(has_ended, run))
        with pytest.raises(GraphTimeout, match=rf"a run of the graph did not finish within {seconds} s"):
            run.result()
        assert graph_runs._turn - turn > seconds / graph_runs.TURN
    until(lambda: not graph_runs._runs)


def test_many_short_runs_are_not_ended(take_turn: Callable[[], None]) -> None:
    """Though a run of the policy is in progress all the time: each lasts for one turn at most, and may for two."""
    policy = OnnxPolicy(masked_mlp(), timeout=graph_runs.TURN)
    ended: list[int] = []
    is_over = Event()

    def act() -> None:
        while not is_over.is_set():
            policy.act(ENDING)
            ended.append(graph_runs._turn)

    thread = ThreadPoolExecutor(1)
    running = thread.submit(act)
    for _ in range(20):
        count = len(ended)
        until(lambda count=count: len(ended) >= count + 2 or running.done())
        take_turn()
    is_over.set()
    running.result()
