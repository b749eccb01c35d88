"""The number of replicas: within bounds, monotone in the load, steady under a constant load, careful without
statistics.
"""

import pickle
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from ray.serve._private.common import DeploymentID, ReplicaID, TimeStampedValue
from ray.serve.config import AutoscalingConfig, AutoscalingPolicy

from serve_app.runtime.autoscaling import LOAD, MARGIN, STALE, LoadPolicy, required_replicas
from serve_app.runtime.launch import DEPLOY_YAML

TARGET = 0.6
targets = st.floats(0.2, 0.9)
loads = st.lists(st.none() | st.floats(0, 4), max_size=20)
bounds = st.tuples(st.integers(1, 10), st.integers(0, 10)).map(lambda each: (each[0], sum(each)))


@given(loads, targets, st.integers(0, 30), bounds)
def test_the_bounds_are_respected(
    loads: list[float | None], target: float, current: int, bounds: tuple[int, int]
) -> None:
    assert bounds[0] <= required_replicas(loads, target, current, *bounds) <= bounds[1]


@given(st.floats(0, 3), loads, targets, st.integers(1, 30), st.floats(0, 3))
def test_more_load_needs_no_fewer_replicas(
    load: float, others: list[float | None], target: float, current: int, more: float
) -> None:
    light, heavy = ([each, *others] for each in (load, load + more))
    assert required_replicas(heavy, target, current, 1, 99) >= required_replicas(light, target, current, 1, 99)


@given(loads.filter(lambda each: None in each), targets, st.integers(1, 30))
def test_no_replica_is_removed_while_a_load_is_unknown(loads: list[float | None], target: float, current: int) -> None:
    assert required_replicas(loads, target, current, 1, 99) >= current


@given(
    st.floats(0, 8),
    st.floats(0.3, 0.9),
    st.floats(0, 0.05),
    st.integers(1, 20),
    st.integers(0, 2**32 - 1),
)
def test_a_constant_load_gets_a_constant_number(
    demand: float, target: float, overhead: float, current: int, seed: int
) -> None:
    """Replicas share the demand, in cores; each has an overhead, cannot use more than a core, and measures up to a
    tenth wrongly. The number may grow and then shrink, but never grows again.
    """
    numbers = [current]
    for row in np.random.default_rng(seed).uniform(0.9, 1.1, size=(30, 20)).tolist():
        share = min(1.0, demand / numbers[-1] + overhead)
        numbers.append(required_replicas([share * each for each in row[: numbers[-1]]], target, numbers[-1], 1, 20))
    grows = [after > before for before, after in pairwise(numbers) if after != before]
    assert grows == sorted(grows, reverse=True)
    assert numbers[-1] == numbers[-2]


@pytest.mark.parametrize(
    ("loads", "current", "expected"),
    [
        ([0.5], 1, 1),
        ([0.7], 1, 2),
        ([1.0], 1, 2),
        ([1.0, 1.0], 2, 4),
        ([1.0, 0.0], 2, 2),
        ([0.27, 0.27], 2, 2),
        ([0.2, 0.2], 2, 1),
        ([0.2], 2, 1),
        ([], 2, 1),
        ([None, 1.9], 2, 4),
        ([0.0, None], 2, 2),
    ],
)
def test_examples(loads: list[float | None], current: int, expected: int) -> None:
    assert required_replicas(loads, TARGET, current, 1, 10) == expected
    assert MARGIN == 0.2


@pytest.mark.parametrize("target", [0, 1, -0.1, 1.5])
def test_an_impossible_target_is_refused(target: float) -> None:
    with pytest.raises(ValueError, match="target must be greater than 0 and less than 1"):
        LoadPolicy(target)


class Controller:
    """Calls a policy as Ray's controller does, with a clock of its own."""

    def __init__(self, replicas: int) -> None:
        application = DeploymentID("PolicyServer", "policy-league")
        self.replicas = [ReplicaID(f"replica-{i}", application) for i in range(replicas)]
        self.reports: dict[ReplicaID, list[TimeStampedValue]] = {}
        self.now = 1000.0
        self.state: dict[str, Any] = {}

    def decide(self, policy: LoadPolicy) -> int:
        context: Any = SimpleNamespace(
            running_replicas=self.replicas,
            raw_metrics={LOAD: self.reports},
            target_num_replicas=len(self.replicas),
            capacity_adjusted_min_replicas=1,
            capacity_adjusted_max_replicas=4,
            policy_state=dict(self.state),
            current_time=self.now,
        )
        wanted, self.state = policy(context)
        return wanted


def test_the_load_is_the_mean_of_the_samples() -> None:
    controller = Controller(1)
    controller.reports = {controller.replicas[0]: [TimeStampedValue(at, load) for at, load in ((1, 0.2), (2, 0.9))]}
    assert controller.decide(LoadPolicy(TARGET)) == 1
    controller.reports[controller.replicas[0]] += [TimeStampedValue(3, 0.9)]
    assert controller.decide(LoadPolicy(TARGET)) == 2


def test_statistics_that_no_longer_change_are_unknown() -> None:
    """Clocks of nodes differ: the age of a report is the time since it arrived."""
    controller, policy = Controller(2), LoadPolicy(TARGET)
    alive, stuck = controller.replicas
    controller.reports = {each: [TimeStampedValue(5e9, 0.01)] for each in controller.replicas}
    assert controller.decide(policy) == 1
    controller.now += STALE + 1
    controller.reports[alive] = [TimeStampedValue(5e9 + 1, 0.01)]
    assert controller.decide(policy) == 2
    controller.reports[stuck] = [TimeStampedValue(5e9 + 1, 0.01)]
    assert controller.decide(policy) == 1


def test_replicas_without_statistics_are_not_removed() -> None:
    assert Controller(3).decide(LoadPolicy(TARGET)) == 3


def test_ray_accepts_the_policy_of_deploy_yaml() -> None:
    """Ray sends it to its controller by value."""
    (deployment,) = yaml.safe_load(DEPLOY_YAML.read_text())["applications"][0]["deployments"]
    config = AutoscalingConfig.model_validate(deployment["autoscaling_config"])
    assert config.look_back_period_s > config.metrics_interval_s
    assert isinstance(config.policy, AutoscalingPolicy)
    serialized = config.policy.get_serialized_policy_def()
    assert serialized is not None
    policy = pickle.loads(serialized)(**config.policy.policy_kwargs)
    assert Controller(3).decide(policy) == 3
    assert b"serve_app.observability" not in serialized
