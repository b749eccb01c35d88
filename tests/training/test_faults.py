"""Faults that went through several processes, as those of an environment do: runner, learner, driver."""

from pathlib import Path

import pytest
import ray

from league.errors import InvalidReward
from training.faults import told

TRACE = Path("/runs/error.txt")


def through_processes(fault: Exception) -> BaseException:
    """What the driver gets of an exception that a task of a task raises."""

    @ray.remote(num_cpus=0.1)
    def runner() -> None:
        raise fault

    @ray.remote(num_cpus=0.1)
    def learner() -> None:
        ray.get(runner.remote())

    with pytest.raises(type(fault)) as raised:
        ray.get(learner.remote())
    return raised.value


@pytest.mark.usefixtures("ray_session")
def test_our_own_errors_come_as_they_are() -> None:
    error = told(through_processes(InvalidReward("league a: player_1: nan")), "a", TRACE)
    assert type(error) is InvalidReward
    assert str(error) == "league a: player_1: nan"


@pytest.mark.usefixtures("ray_session")
def test_others_are_told_by_their_kind_their_words_and_the_line_of_the_users_code() -> None:
    error = told(through_processes(KeyError("ball\nand more")), "a", TRACE)
    line = next(n for n, text in enumerate(Path(__file__).read_text().splitlines(), 1) if "raise fault" in text)
    assert str(error).startswith("league a: training broke off with KeyError: 'ball\\nand more' at ")
    assert f"{__file__}:{line};" in str(error)
    assert str(error).endswith("the whole trace is in /runs/error.txt")


def test_an_error_without_words_or_place() -> None:
    assert str(told(MemoryError(), "a", TRACE)) == (
        "league a: training broke off with MemoryError; the whole trace is in /runs/error.txt"
    )
