from typing import Any

import pytest

from league.errors import ConfigError
from tests.training.leagues import tictactoe
from training.algorithms.phases import check, learning

POLICIES = ("a", "b", "c")


def planned(policies: Any, **training: Any) -> Any:
    return tictactoe(policies_to_train=policies, **training).training


@pytest.mark.parametrize(("policies", "expected"), [(None, POLICIES), (["c", "a"], ("a", "c"))])
def test_a_list_holds_at_every_update(policies: Any, expected: tuple[str, ...]) -> None:
    assert [learning(planned(policies), POLICIES, i) for i in range(3)] == [expected] * 3


def test_phases_follow_one_another_in_a_circle() -> None:
    settings = planned([{"policies": ["a"], "iterations": 2}, {"policies": ["c", "b"], "iterations": 1}])
    check(settings, POLICIES)
    found = [learning(settings, POLICIES, i) for i in range(7)]
    assert found == [("a",), ("a",), ("b", "c")] * 2 + [("a",)]


@pytest.mark.parametrize("policies", [["a", "d"], [{"policies": ["d"], "iterations": 1}]])
def test_a_policy_that_there_is_not_is_named(policies: Any) -> None:
    with pytest.raises(ConfigError, match="policies_to_train: no policy 'd'; the league has a, b, c"):
        check(planned(policies), POLICIES)


@pytest.mark.parametrize("policies", [["a"], [{"policies": ["a"], "iterations": 1}]])
def test_a_policy_cannot_rest_while_others_change_its_encoder(policies: Any) -> None:
    with pytest.raises(ConfigError, match="with shared_encoder all policies learn together"):
        check(planned(policies, shared_encoder=True), POLICIES)
    check(planned(list(POLICIES), shared_encoder=True), POLICIES)
    check(planned(None, shared_encoder=True), POLICIES)
