from pathlib import Path
from typing import Any

import numpy as np
import pytest

from league.environments.building import interface
from league.errors import ConfigError, LeagueError
from tests.support.leagues.training_leagues import tictactoe
from training.runs.callbacks import Callbacks, FinishedEpisode
from training.runs.train import check
from training.sampling.play_metrics import PlayedEpisodes

INTERFACE = interface(tictactoe())
EPISODES = PlayedEpisodes(np.array([5, 9]), np.array([[3, 2], [5, 0]]), np.array([[1.0, -1.0], [0.0, 0.0]]))
"""The second one was played against an opponent."""
VERSIONS: Any = ["tictactoe@1", "tictactoe@2"]


class Recording:
    calls: list[Any]

    def __init__(self) -> None:
        Recording.calls = []

    def on_episode(self, episode: FinishedEpisode) -> dict[str, float]:
        self.calls.append(episode)
        return {"length": episode.length} | (
            {"second": episode.returns["player_2"]} if len(episode.returns) > 1 else {}
        )

    def on_update(self, metrics: dict[str, float]) -> dict[str, float]:
        self.calls.append(metrics)
        return {"twice": 2 * np.float32(metrics["return"]), "undefined": float("nan")}

    def on_version(self, version: Any) -> None:
        self.calls.append(version)

    def on_end(self, versions: Any) -> None:
        self.calls.append(versions)


class Faulty:
    def on_update(self, metrics: dict[str, float]) -> Any:
        return {"whole": [1], "text": None}[{1.0: "whole", 2.0: "text"}[metrics["return"]]]


class Unbuilt:
    def __init__(self) -> None:
        raise OSError("no such host")  # Unbuilt

    def on_end(self, versions: Any) -> None: ...


class Empty:
    def on_updates(self) -> None: ...


def callbacks(*names: str) -> Callbacks:
    return Callbacks([f"{__name__}:{name}" for name in names], INTERFACE)


def test_hooks_are_called_in_order_and_their_metrics_are_collected() -> None:
    followers = callbacks("Recording")
    followers.add(VERSIONS[0])
    metrics = followers.report([EPISODES], [{"return": 0.5}, {"return": 0.25}])
    followers.add(VERSIONS[1])
    followers.end(VERSIONS)
    assert metrics == {"callbacks/length": 7.0, "callbacks/second": -1.0, "callbacks/twice": 0.5}
    assert Recording.calls == [
        FinishedEpisode(5, {"player_1": 1.0, "player_2": -1.0}),
        FinishedEpisode(9, {"player_1": 0.0}),
        *({"return": 0.5}, {"return": 0.25}),
        VERSIONS[0],
        VERSIONS[1],
        VERSIONS,
    ]


@pytest.mark.parametrize(
    ("value", "problem"),
    [
        (3.0, r"raises \(.*test_callbacks\.py, line \d+\): KeyError: 3\.0"),
        (1.0, r"raises: TypeError: it returned '\[1\]', expected None or a dictionary from names to numbers"),
    ],
)
def test_the_first_fault_requests_the_end_and_is_raised_there(value: float, problem: str) -> None:
    followers, requests = callbacks("Faulty", "Recording"), list[str]()
    followers.request_stop = lambda: requests.append("stop")
    assert followers.report([], [{"return": 2.0}]) == {"callbacks/twice": 4.0}
    assert requests == []
    calls = len(Recording.calls)
    for _ in range(2):
        assert followers.report([EPISODES], [{"return": value}]).keys() <= {"callbacks/length", "callbacks/second"}
    with pytest.raises(LeagueError, match=rf"^training\.callbacks: {__name__}:Faulty\.on_update {problem}"):
        followers.end(VERSIONS)
    assert requests == ["stop"]
    assert len(Recording.calls) == calls + 2, "the episodes before the fault, and nothing after it"


@pytest.mark.parametrize("entry_point", [f"{__name__}:Empty", f"{__name__}:callbacks"])
def test_a_class_without_hooks_is_refused_before_training(entry_point: str) -> None:
    league = tictactoe(callbacks=[entry_point])
    expected = "is no class with a method on_episode, on_update, on_version or on_end"
    with pytest.raises(ConfigError, match=f"^training.callbacks: {entry_point} {expected}"):
        check(league, interface(league))


def test_an_instance_that_cannot_be_created_is_named_with_its_line() -> None:
    (number,) = (
        number for number, line in enumerate(Path(__file__).read_text().splitlines(), 1) if line.endswith("  # Unbuilt")
    )
    with pytest.raises(ConfigError, match=rf"Unbuilt cannot be created \(.*, line {number}\): OSError: no such host"):
        callbacks("Unbuilt")


def test_without_callbacks_nothing_is_computed() -> None:
    assert callbacks().report([EPISODES], [{"return": 1.0}]) == {}
