"""Gradient steps on samples of replay buffers: several at once equal single ones, and none waits for a GPU."""

import copy
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch
from ray.rllib.utils.metrics import WEIGHTS_SEQ_NO
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from league.config.league import LeagueConfig
from tests.support.algorithms import running
from tests.support.leagues.training_leagues import maddpg, solvable_by_dqn
from training.algorithms import off_policy
from training.replay_buffer import Sample

MEMORY = {"recurrence": {"width": 8, "sequence": 3}}
NORMAL = {"normalize_observations": True}
PAIR = {"a": ["player_0"], "b": ["player_1"]}
LEAGUES: dict[str, Callable[[], LeagueConfig]] = {
    "dqn": lambda: solvable_by_dqn("masked", **NORMAL),
    "dqn, noisy and distributional": lambda: solvable_by_dqn(
        "masked", noisy=True, distributional={"low": -1, "high": 5}
    ),
    "dqn, recurrent": lambda: solvable_by_dqn("masked", **MEMORY, **NORMAL),
    "qmix": lambda: solvable_by_dqn("discrete", {"agents": 2}, PAIR, algorithm="qmix", **NORMAL),
    "qmix, recurrent": lambda: solvable_by_dqn("discrete", {"agents": 2}, PAIR, algorithm="qmix", **MEMORY),
    "vdn": lambda: solvable_by_dqn("discrete", {"agents": 2}, PAIR, algorithm="qmix", mixer="vdn", double=False),
    "maddpg, discrete": lambda: maddpg("discrete", {"agents": 2}, PAIR),
    "maddpg, continuous": lambda: maddpg("summing", {}, PAIR, **NORMAL),
}


@pytest.fixture(scope="module")
def algorithm(request: pytest.FixtureRequest, ray_session: None) -> Iterator[Any]:
    """Its buffers are filled, and it has taken some gradient steps."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(off_policy, "ITERATION_STEPS", 256)
        with running(LEAGUES[request.param]().with_training(learning_starts=64)) as algorithm:
            while not algorithm._learner.updates:
                algorithm.train()
            yield algorithm


def samples(algorithm: Any, steps: int) -> tuple[tuple[str, ...], dict[str, Sample]]:
    learning = tuple(algorithm.config.policies)
    draws = steps * algorithm.draws_per_step(learning)
    return learning, {key: algorithm.draw_sample(replay, draws) for key, replay in algorithm.replays.items()}


def part(sample: Sample, number: int, parts: int) -> Sample:
    rows = {name: np.split(column, parts)[number] for name, column in sample.rows.items()}
    return Sample(rows, np.split(sample.indices, parts)[number], np.split(sample.weights, parts)[number])


@pytest.mark.parametrize(
    "algorithm", ["dqn, noisy and distributional", "qmix, recurrent", "maddpg, discrete"], indirect=True
)
def test_several_steps_equal_single_ones(algorithm: Any) -> None:
    learner = algorithm._learner
    state = copy.deepcopy(learner.get_state())
    # Otherwise, RLlib keeps the weights that it has, as newer ones.
    del state[WEIGHTS_SEQ_NO]
    learning, drawn = samples(algorithm, 3)

    def learned(learn: Callable[[], Any]) -> dict[str, torch.Tensor]:
        learner.set_state(copy.deepcopy(state))
        torch.manual_seed(0)
        learn()
        networks = learner.networks | {f"target of {key}": target for key, target in learner.targets.items()}
        return {
            f"{key}.{parameter}": value.clone()
            for key, network in networks.items()
            for parameter, value in network.state_dict().items()
        }

    def learn_singly() -> None:
        for number in range(3):
            learner.learn({key: part(sample, number, 3) for key, sample in drawn.items()}, learning)

    at_once = learned(lambda: learner.learn(drawn, learning, 3))
    singly = learned(learn_singly)
    before = learned(lambda: None)
    assert all(torch.equal(value, singly[key]) for key, value in at_once.items())
    assert any(not torch.equal(value, before[key]) for key, value in at_once.items())


class NeverWaits(TorchDispatchMode):
    """Fails at operations that would wait for a GPU: values or shapes that the host needs, and copies from it.

    By default, tensors are created on another device than those of the learner.
    """

    SYNCHRONISING = (
        torch.ops.aten._local_scalar_dense.default,
        torch.ops.aten.lift_fresh.default,
        torch.ops.aten.masked_select.default,
        torch.ops.aten.nonzero.default,
    )

    def __enter__(self) -> Any:
        self._default = torch.device("meta")
        self._default.__enter__()
        return super().__enter__()

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        self._default.__exit__(*error)

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)]
        assert func not in self.SYNCHRONISING, f"{func} waits for the device"
        assert len({tensor.device for tensor in tensors}) <= 1, f"{func} with tensors of several devices"
        if func in (torch.ops.aten.index.Tensor, torch.ops.aten.index_put_.default):
            assert all(index is None or index.dtype != torch.bool for index in args[1]), f"{func} with a mask"
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("algorithm", LEAGUES, indirect=True)
def test_a_step_never_waits_for_a_gpu(algorithm: Any) -> None:
    learning, drawn = samples(algorithm, 1)
    learner = algorithm._learner
    batches = {key: learner.batch(sample) for key, sample in drawn.items()}
    updates = learner.updates
    with NeverWaits():
        learner.step(batches, learning)
        learner.update_targets()
    assert learner.updates == updates + 1
    assert learner.results()


def test_the_check_detects_waiting(subtests: pytest.Subtests) -> None:
    operations: dict[str, Callable[[torch.Tensor], Any]] = {
        "item": lambda x: x.sum().item(),
        "bool": lambda x: bool((x > 0).any()),
        "mask": lambda x: x[x > 0],
        "list": lambda x: x[:, [0, 1]],
        "arange": lambda x: x[torch.arange(2)],
        "bound": lambda x: x.clamp(torch.zeros(4)),
        "constant": lambda x: torch.as_tensor([1.0, 2.0]) * x[:, :2],
    }
    for name, operation in operations.items():
        with subtests.test(name), pytest.raises((AssertionError, RuntimeError)), NeverWaits():
            operation(torch.ones(3, 4, device="cpu"))
