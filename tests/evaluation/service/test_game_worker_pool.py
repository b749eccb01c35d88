"""Worker processes for games with people: a failing league does not affect the others."""

from __future__ import annotations

import asyncio
import errno
import json
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from typing import Any, NoReturn

import pytest
from PIL import Image

from evaluation.matches.tournament import evaluate
from evaluation.service import game_worker_pool
from evaluation.service.game_worker_pool import GameWorkerPool
from league import subprocesses
from league.environments.building import interface
from league.errors import (
    EnvironmentMismatch,
    GameCrashed,
    GameHung,
    IllegalAction,
    NotFound,
    NotReady,
    Overloaded,
    UnknownVersion,
    WorkerLost,
)
from league.registry.registry import Registry
from league.results.ledger import Ledger
from league.service_requests import (
    GameRequest,
    GameResponse,
    HumanPlayRequest,
    PlayabilityRequest,
    RecordingRequest,
    VideoRequest,
)
from tests.support.leagues import tictactoe
from tests.support.leagues.tictactoe import LEAGUE
from tests.support.processes import running_module

LONG = 120.0


@pytest.fixture(scope="module")
def registry(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Registry]:
    """Tic-tac-toe with a version and a match, and leagues whose first move hangs, raises or ends the process."""
    opened = tictactoe.registry(tmp_path_factory.mktemp("stages") / "home")
    tictactoe.publish(opened, tictactoe.graph(wins=True))
    evaluate(LEAGUE, ["tictactoe@1", "script:random"], registry=opened, blocks=1)
    for name in ("Hanging", "Raising", "Dying", "BlockingSignals"):
        config = tictactoe.config(
            league=name.lower(), environment={"entry_point": f"tests.support.environments.hanging:{name}"}
        )
        opened.leagues.register(config, interface(config))
    with pytest.MonkeyPatch.context() as patch:
        for name, value in opened.storage.environment.items():
            patch.setenv(name, value)
        yield opened
    opened.close()


@contextmanager
def running(**settings: Any) -> Iterator[GameWorkerPool]:
    pool = GameWorkerPool(**settings)
    try:
        yield pool
    finally:
        pool.close()


@pytest.fixture(scope="module")
def shared(registry: Registry) -> Iterator[GameWorkerPool]:
    with running() as pool:
        yield pool


def game_request(operation: Any, league: str = LEAGUE) -> GameRequest:
    return GameRequest(league=league, conditions="1-greedy", operation=operation)


def submit(pool: GameWorkerPool, operation: Any, league: str = LEAGUE, timeout: float = LONG) -> GameResponse:
    return asyncio.run(pool.submit(game_request(operation, league), timeout))


def play_request(
    *actions: int, opponent: str = "tictactoe@1", agent: str = "player_1", seed: int = 0
) -> HumanPlayRequest:
    return HumanPlayRequest(opponent=opponent, agent=agent, actions=actions, seed=seed, chances=True)


def document_of(answer: GameResponse) -> dict[str, Any]:
    assert answer.media_type == "application/json"
    return dict(json.loads(answer.content))


def test_playable_agents_are_listed(shared: GameWorkerPool) -> None:
    assert document_of(submit(shared, PlayabilityRequest())) == {
        "league": LEAGUE,
        "playable": True,
        "why": None,
        "agents": [
            {
                "agent": f"player_{i}",
                "side": f"player_{i}",
                "actions": 9,
                "start": 0,
                "names": {},
                "keys": {},
                "color": color,
            }
            for i, color in ((1, "#6183e7"), (2, "#f53a3a"))
        ],
        "opponents": ["tictactoe@1", "script:random", "script:one_ply"],
        "draws": True,
        "board": [[0, 3, 6], [1, 4, 7], [2, 5, 8]],
        "board_area": [0.02, 0.02, 0.99, 0.97],
        "reveals": False,
    }


def test_a_pool_is_in_use_for_some_minutes_after_a_request(
    shared: GameWorkerPool, monkeypatch: pytest.MonkeyPatch
) -> None:
    submit(shared, PlayabilityRequest())
    assert shared.is_in_use
    monkeypatch.setattr(game_worker_pool, "IDLE", 0.0)
    submit(shared, PlayabilityRequest())
    assert not shared.is_in_use


def test_a_process_that_cannot_be_started_is_tried_again(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> NoReturn:
        raise OSError(errno.EAGAIN, "no more processes")

    with running() as pool:
        with monkeypatch.context() as patched:
            patched.setattr(subprocesses, "Subprocess", fail)
            with pytest.raises(OSError, match="no more processes"):
                submit(pool, PlayabilityRequest())
        assert document_of(submit(pool, PlayabilityRequest()))["playable"] is True


def test_a_recorded_game_has_images_and_a_video(shared: GameWorkerPool, registry: Registry) -> None:
    match = Ledger(registry).matches(league=LEAGUE)[0]
    record = document_of(submit(shared, RecordingRequest(match=match.id, game=1, first=1, end=3)))
    assert [step["step"] for step in record["steps"]] == [1, 2]
    assert all(step["picture"].startswith("data:image/png;base64,") for step in record["steps"])
    video = submit(shared, VideoRequest(match=match.id, game=1))
    assert video.media_type == "image/gif"
    assert Image.open(BytesIO(video.content)).n_frames == record["length"] + 1


def test_a_game_against_a_version_is_played(shared: GameWorkerPool) -> None:
    state = document_of(submit(shared, play_request(4)))
    assert [step["moves"][0]["action"] for step in state["steps"][1:]] == [4, state["steps"][2]["moves"][0]["action"]]
    assert state["picture"].startswith("data:image/png;base64,")
    assert state["chances"][0][0] in state["legal"]
    processes = running_module("evaluation.service.game_worker")
    submit(shared, play_request(5))
    assert running_module("evaluation.service.game_worker") == processes, "one process per league"


def test_errors_keep_their_type(shared: GameWorkerPool) -> None:
    for operation, error, message in (
        (play_request(4, 4), IllegalAction, r"actions\[1\]: 4 is illegal"),
        (play_request(opponent="tictactoe@9"), UnknownVersion, "tictactoe"),
        (VideoRequest(match="nowhere/0", game=0), NotFound, "nowhere"),
    ):
        with pytest.raises(error, match=message):
            submit(shared, operation)


def test_immutable_answers_are_cached(shared: GameWorkerPool) -> None:
    assert submit(shared, play_request(4)) is submit(shared, play_request(4))
    assert submit(shared, PlayabilityRequest()) is not submit(shared, PlayabilityRequest())


def test_a_slow_request_can_be_repeated(registry: Registry) -> None:
    with running() as pool:

        async def submit_until_ready() -> tuple[set[str], GameResponse]:
            messages = set()
            while True:
                try:
                    return messages, await pool.submit(game_request(play_request(0)), timeout=0.05)
                except NotReady as error:
                    messages.add(str(error))

        messages, answer = asyncio.run(submit_until_ready())
    # A process takes longer than 50 ms to start.
    assert messages == {"the environment of tictactoe is starting or busy: repeat the request for its response"}
    assert document_of(answer)["over"] is False


def test_a_hanging_game_is_aborted_and_others_are_played(registry: Registry) -> None:
    with running(seconds=5.0) as pool:

        async def both() -> None:
            hung = asyncio.create_task(
                pool.submit(game_request(play_request(0, opponent="script:random"), "hanging"), LONG)
            )
            await pool.submit(game_request(play_request(0)), LONG)
            with pytest.raises(GameHung, match="a game of hanging did not end within 5 s"):
                await hung
            with pytest.raises(NotReady):  # the hang is not cached
                await pool.submit(game_request(play_request(0, opponent="script:random"), "hanging"), 0.01)

        asyncio.run(both())


def test_native_code_that_does_not_return_ends_the_process(registry: Registry) -> None:
    with running(seconds=5.0, grace=1.0) as pool:
        with pytest.raises(GameHung, match="its process was killed after 6 s"):
            submit(pool, play_request(0, opponent="script:random"), "blockingsignals")
        assert document_of(submit(pool, PlayabilityRequest(), "blockingsignals"))["playable"]


def test_a_process_that_dies_is_reported_and_replaced(registry: Registry) -> None:
    with running() as pool:
        with pytest.raises(WorkerLost, match="plays games of dying died"):
            submit(pool, play_request(0, opponent="script:random"), "dying")
        assert document_of(submit(pool, PlayabilityRequest(), "dying"))["playable"]
        (process,) = running_module("evaluation.service.game_worker")[-1:]
        os.kill(process, signal.SIGKILL)
        assert document_of(submit(pool, play_request(opponent="script:random"), "dying"))["legal"]


def test_an_exception_of_the_environment_is_reported_and_the_next_game_is_independent(shared: GameWorkerPool) -> None:
    for _ in range(2):
        with pytest.raises(GameCrashed, match="the board is gone"):
            submit(shared, play_request(0, opponent="script:random"), "raising")
    assert document_of(submit(shared, play_request(opponent="script:random"), "raising"))["legal"] == list(range(9))


def test_an_environment_that_cannot_be_created_is_a_server_error(shared: GameWorkerPool, registry: Registry) -> None:
    lost = tictactoe.config(league="lost", environment={"entry_point": "games.none:none"})
    registry.leagues.register(lost, registry.leagues.get(LEAGUE).interface)
    with pytest.raises(GameCrashed, match=r"the environment of lost cannot be created: .*games\.none"):
        submit(shared, PlayabilityRequest(), "lost")


def test_a_changed_environment_is_used_for_the_next_game(registry: Registry) -> None:
    league = tictactoe.config(league="moving")
    registry.leagues.register(league, interface(league))
    with running() as pool:
        operation = play_request(0, opponent="script:first")
        assert len(document_of(submit(pool, operation, "moving"))["steps"]) == 3
        other = tictactoe.config(
            league="moving", environment={"entry_point": "tests.support.environments.hanging:Raising"}
        )
        registry.leagues.register(other, interface(other))
        with pytest.raises(GameCrashed):
            asyncio.run(pool.submit(GameRequest(league="moving", conditions="2-greedy", operation=operation), LONG))


def test_idle_leagues_are_evicted_but_not_during_a_game(registry: Registry) -> None:
    with running(most=1, seconds=5.0) as pool:

        async def submit_several() -> None:
            hung = asyncio.create_task(
                pool.submit(game_request(play_request(0, opponent="script:random"), "hanging"), LONG)
            )
            await asyncio.sleep(0)
            with pytest.raises(Overloaded, match="all 1 processes for games are in use by other leagues"):
                await pool.submit(game_request(PlayabilityRequest()), LONG)
            with pytest.raises(GameHung):
                await hung
            await pool.submit(game_request(PlayabilityRequest()), LONG)

        before = running_module("evaluation.service.game_worker")
        asyncio.run(submit_several())
        assert len(set(running_module("evaluation.service.game_worker")) - set(before)) == 1


def test_the_number_of_waiting_requests_is_limited(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(game_worker_pool, "MOST_WAITING", 2)
    with running() as pool:

        async def submit_many() -> list[Any]:
            requests = [pool.submit(game_request(play_request(seed=seed)), LONG) for seed in range(3)]
            return list(await asyncio.gather(*requests, return_exceptions=True))

        *answered, rejected = asyncio.run(submit_many())
    assert all(isinstance(each, GameResponse) for each in answered)
    assert isinstance(rejected, Overloaded)


def test_the_size_of_the_cache_is_limited(shared: GameWorkerPool, monkeypatch: pytest.MonkeyPatch) -> None:
    first = submit(shared, play_request(1))
    monkeypatch.setattr(game_worker_pool, "CACHE_BYTES", len(first.content))
    submit(shared, play_request(2))
    submit(shared, play_request(3))
    assert submit(shared, play_request(1)) is not first


def test_only_leagues_with_discrete_actions_are_playable(registry: Registry, shared: GameWorkerPool) -> None:
    config = tictactoe.config(
        league="spread",
        environment={
            "entry_point": "mpe2.simple_spread_v3",
            "kwargs": {"max_cycles": 4, "continuous_actions": True},
        },
        play={"opening_plies": 0},
    )
    registry.leagues.register(config, interface(config))
    document = document_of(submit(shared, PlayabilityRequest(), "spread"))
    assert (document["playable"], document["agents"]) == (False, [])
    assert document["why"] == "human play needs Discrete actions, but its agents have Box"
    with pytest.raises(EnvironmentMismatch, match="agent_0 has Box"):
        submit(shared, play_request(opponent="script:random", agent="agent_0"), "spread")
