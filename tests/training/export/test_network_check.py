"""Networks of users are checked before training, and graphs on observations from play."""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from league.environments.building import interface
from league.errors import ConfigError
from league.spaces import Discrete
from tests.support.leagues.training_leagues import maddpg, tictactoe
from tests.support.policies import networks
from training.export.network_check import check_network
from training.export.parity import influence
from training.runs.train import check

PLAIN: dict[str, Any] = {"hidden": [256, 256]}
"""The default, in place of the league's."""


def marked(mark: str) -> str:
    """File and line of a comment among the networks."""
    lines = Path(networks.__file__).read_text().splitlines()
    (number,) = (number for number, line in enumerate(lines, 1) if line.endswith(f"  # {mark}"))
    return f"{networks.__file__}, line {number}"


@pytest.mark.parametrize("training", [{}, {"normalize_observations": True}, {"algorithm": "dqn"}, {"recurrence": {}}])
def test_a_network_is_accepted(training: dict[str, Any]) -> None:
    league = tictactoe(network=networks.settings("Good"), **PLAIN, **training)
    check(league, interface(league))


def test_without_a_network_nothing_is_played() -> None:
    league = tictactoe()
    check_network(league.model_copy(update={"environment": None}), interface(league))


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("Branching", "cannot be exported to ONNX: GuardOnDataDependentSymNode: Could not guard"),
        ("Decomposing", "cannot be exported to ONNX: DispatchError: No ONNX function found for"),
        ("Drawn", "differs from its ONNX graph by up to"),
        ("Random", "computes other outputs for 64 of 64 observations in a second run: as with Dropout"),
        ("Mixing", "computes other outputs for 64 of 64 observations alone than in a batch: its rows influence each"),
        ("Raising", "raises IndexError: index 99 is out of bounds"),
        ("InPlace", "raises RuntimeError: one of the variables needed for gradient computation"),
        ("Paired", "returned a tuple: expected float32 [64, 8], a row of its `width` for each observation"),
        ("Infinite", "returned numbers that are not finite"),
    ],
)
def test_a_faulty_network_is_refused_with_its_line(name: str, problem: str, capfd: pytest.CaptureFixture[str]) -> None:
    league = tictactoe(network=networks.settings(name), **PLAIN)
    with pytest.raises(ConfigError) as refused:
        check(league, interface(league))
    message = f"training.network: {networks.__name__}:{name} ({marked(name)}) {problem}"
    assert str(refused.value).startswith(message)
    assert "File" not in "".join(capfd.readouterr()), "what torch prints about it"


def test_another_width_than_declared_is_refused() -> None:
    league = tictactoe(network=networks.settings("Good", width=9), **PLAIN)
    problem = f"Good ({marked('width')}) returned float32 [64, 8]: expected float32 [64, 9]"
    with pytest.raises(ConfigError, match=re.escape(problem)):
        check(league, interface(league))


@pytest.mark.parametrize(
    ("network", "problem"),
    [
        (networks.settings("Good", width=None), "has the width None, expected the number of its features as an int"),
        (networks.settings("Good", depth=1), "cannot be created: TypeError: .* unexpected keyword argument 'depth'"),
        (networks.settings("Unbuilt"), rf"cannot be created \({re.escape(marked('Unbuilt'))}\): KeyError: 'planes'"),
        (networks.settings("no_module"), "returned a int, expected an nn.Module"),
        (networks.settings("Goood"), "has no 'Goood', did you mean 'Good'?"),
        ({"entry_point": "no_such_module:Net"}, "cannot import 'no_such_module'"),
    ],
)
def test_what_is_no_network_is_refused(network: dict[str, Any], problem: str) -> None:
    league = tictactoe(network=network, **PLAIN)
    with pytest.raises(ConfigError, match=rf"^training\.network: .*{problem}"):
        check(league, interface(league))


def test_a_network_takes_the_place_of_layers() -> None:
    with pytest.raises(ConfigError, match="network takes the place of hidden: remove one of them"):
        tictactoe(network=networks.settings("Good"))
    with pytest.raises(ConfigError, match=r"entry_point: expected package\.module:name"):
        tictactoe(network={"entry_point": "networks"}, **PLAIN)
    # Those of MADDPG are the critics', too.
    maddpg("remembering", {}, {"shared": ["*"]}, network=networks.settings("Good"))


ROWS = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)


def outputs(logits: Callable[[NDArray], NDArray]) -> Callable[[Mapping[str, NDArray]], list[NDArray]]:
    """A graph of `x` with greedy actions."""

    def run(arrays: Mapping[str, NDArray]) -> list[NDArray]:
        values = logits(arrays["x"])
        return [values.argmax(axis=1), values]

    return run


def test_rows_by_themselves_have_no_influence() -> None:
    assert influence(outputs(lambda x: 2 * x), {"x": ROWS}, Discrete(n=3)) is None
    assert influence(outputs(lambda x: np.where(x > 0, -np.inf, x * np.nan)), {"x": ROWS}, Discrete(n=3)) is None


OTHER_ROWS = "computes other outputs for 20 of 20 observations alone than in a batch: its rows"


@pytest.mark.parametrize(
    ("logits", "problem"),
    [
        (lambda x: x - x.mean(axis=0), OTHER_ROWS),
        (lambda x: x + (len(x) > 1), OTHER_ROWS),
        (lambda x: x[::-1], OTHER_ROWS),
        (
            lambda x: x + (np.arange(len(x))[:, np.newaxis] * 10 if x[0, 0] != ROWS[0, 0] and len(x) > 1 else 0),
            "computes other outputs for 19 of 20 observations in another order: its rows",
        ),
        (
            lambda x: x if len(x) > 1 else np.ones((2, 3)),
            "fails on a single observation: 20 single runs have an output",
        ),
    ],
)
def test_other_rows_that_matter_are_found(logits: Callable[[NDArray], NDArray], problem: str) -> None:
    assert str(influence(outputs(logits), {"x": ROWS}, Discrete(n=3))).startswith(problem)


def test_chance_is_found() -> None:
    rng = np.random.default_rng(0)
    problem = influence(outputs(lambda x: x + rng.normal(size=x.shape)), {"x": ROWS})
    assert str(problem).startswith("computes other outputs for 20 of 20 observations in a second run: as with Dropout")


@pytest.mark.parametrize(("gap", "wrong"), [(1e-6, False), (1e-4, True)])
def test_only_near_ties_excuse_a_greedy_action(gap: float, wrong: bool) -> None:
    def logits(x: NDArray) -> NDArray:
        return np.stack([np.zeros(len(x)), np.full(len(x), gap if len(x) > 1 else -gap)], axis=1)

    assert (influence(outputs(logits), {"x": ROWS}, Discrete(n=2)) is not None) is wrong
