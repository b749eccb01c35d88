"""Worker processes for games with people: a failing league does not affect the others."""

from __future__ import annotations

import asyncio
import errno
import json
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import closing
from io import BytesIO
from pathlib import Path
from typing import Any, NoReturn

import pytest
from PIL import Image

from evaluation.matches.tournament import evaluate
from evaluation.service import game_worker_pool
from evaluation.service.game_worker import GameWorker
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
from tests.support.environments.hanging import Raising
from tests.support.leagues import tictactoe
from tests.support.leagues.tictactoe import LEAGUE
from tests.support.waiting import until

LONG = 240.0


HASTY, GRACE = 1.0, 0.5
"""Seconds for a game that does not end, and until its process is killed."""


@pytest.fixture(scope="module")
def registry(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Registry]:
    """Tic-tac-toe with a version and a match, and leagues whose first move hangs, raises or ends the process."""
    opened = tictactoe.registry(tmp_path_factory.mktemp("stages") / "home")
    tictactoe.publish(opened, tictactoe.graph(wins=True))
    evaluate(LEAGUE, ["tictactoe@1", "script:random"], registry=opened, blocks=1)
    for name in ("Hanging", "Raising", "Dying", "BlockingSignals"):
        environment = {"entry_point": f"tests.support.environments.hanging:{name}"}
        config = tictactoe.config(league=name.lower(), environment=environment)
        opened.leagues.register(config, interface(config))
    with pytest.MonkeyPatch.context() as patch:
        for name, value in opened.storage.environment.items():
            patch.setenv(name, value)
        yield opened
    opened.close()


@pytest.fixture(scope="module")
def pool(registry: Registry) -> Iterator[GameWorkerPool]:
    """One for all tests: each of its processes imports for a second or two. Two leagues have games that do not end."""
    pool = GameWorkerPool(seconds=HASTY, grace=GRACE, most=16)
    for league in ("hanging", "blockingsignals"):
        pool._worker(league)
    pool._seconds = LONG
    yield pool
    pool.close()


def process_of(pool: GameWorkerPool, league: str = LEAGUE) -> int:
    pid = pool._workers[league]._process.pid
    assert pid is not None
    return pid


@pytest.fixture
def pause(pool: GameWorkerPool) -> Iterator[threading.Event]:
    """Requests for games of tic-tac-toe wait until it is set."""
    event = threading.Event()
    pool._worker(LEAGUE)._thread.submit(event.wait)
    yield event
    event.set()


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


def test_playable_agents_are_listed(pool: GameWorkerPool) -> None:
    agents = [
        {"agent": name, "side": name, "actions": 9, "start": 0, "names": {}, "keys": {}, "color": color}
        for name, color in (("player_1", "#6183e7"), ("player_2", "#f53a3a"))
    ]
    assert document_of(submit(pool, PlayabilityRequest())) == {
        "league": LEAGUE,
        "playable": True,
        "why": None,
        "agents": agents,
        "opponents": ["tictactoe@1", "script:random", "script:one_ply"],
        "draws": True,
        "board": [[0, 3, 6], [1, 4, 7], [2, 5, 8]],
        "board_area": [0.02, 0.02, 0.99, 0.97],
        "reveals": False,
    }


def test_a_pool_is_in_use_for_minutes_after_a_request(pool: GameWorkerPool, monkeypatch: pytest.MonkeyPatch) -> None:
    submit(pool, PlayabilityRequest())
    assert pool.is_in_use
    monkeypatch.setattr(game_worker_pool, "IDLE", 0.0)
    submit(pool, PlayabilityRequest())
    assert not pool.is_in_use


def test_a_recorded_game_has_images_and_a_video(pool: GameWorkerPool, registry: Registry) -> None:
    match = Ledger(registry).matches(league=LEAGUE)[0]
    record = document_of(submit(pool, RecordingRequest(match=match.id, game=1, first=1, end=3)))
    assert [step["step"] for step in record["steps"]] == [1, 2]
    assert all(step["picture"].startswith("data:image/png;base64,") for step in record["steps"])
    video = submit(pool, VideoRequest(match=match.id, game=1))
    assert video.media_type == "image/gif"
    assert Image.open(BytesIO(video.content)).n_frames == record["length"] + 1


def test_a_game_against_a_version_is_played(pool: GameWorkerPool) -> None:
    state = document_of(submit(pool, play_request(4)))
    assert [step["moves"][0]["action"] for step in state["steps"][1:]] == [4, state["steps"][2]["moves"][0]["action"]]
    assert state["picture"].startswith("data:image/png;base64,")
    assert state["chances"][0][0] in state["legal"]
    process = process_of(pool)
    submit(pool, play_request(5))
    assert process_of(pool) == process, "one process per league"


def test_errors_keep_their_type(pool: GameWorkerPool) -> None:
    for operation, error, message in (
        (play_request(4, 4), IllegalAction, r"actions\[1\]: 4 is illegal"),
        (play_request(opponent="tictactoe@9"), UnknownVersion, "tictactoe"),
        (VideoRequest(match="nowhere/0", game=0), NotFound, "nowhere"),
    ):
        with pytest.raises(error, match=message):
            submit(pool, operation)


def test_immutable_answers_are_cached_up_to_a_size(pool: GameWorkerPool, monkeypatch: pytest.MonkeyPatch) -> None:
    first = submit(pool, play_request(1))
    assert submit(pool, play_request(1)) is first
    assert submit(pool, PlayabilityRequest()) is not submit(pool, PlayabilityRequest())
    monkeypatch.setattr(game_worker_pool, "CACHE_BYTES", len(first.content))
    submit(pool, play_request(2))
    submit(pool, play_request(3))
    assert submit(pool, play_request(1)) is not first


def test_slow_requests_are_repeated(
    pool: GameWorkerPool, pause: threading.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def submit_twice() -> GameResponse:
        request = game_request(play_request(0, seed=1))
        with pytest.raises(NotReady, match="of tictactoe is starting or busy: repeat the request for its response"):
            await pool.submit(request, timeout=0.0)
        monkeypatch.setattr(game_worker_pool, "MOST_WAITING", 0)  # the repetition is no further request
        pause.set()
        return await pool.submit(request, LONG)

    assert document_of(asyncio.run(submit_twice()))["over"] is False


def test_a_hanging_game_is_aborted_and_others_are_played(pool: GameWorkerPool) -> None:
    request = game_request(play_request(0, opponent="script:random"), "hanging")

    async def both() -> None:
        hung = asyncio.create_task(pool.submit(request, LONG))
        await pool.submit(game_request(play_request(0)), LONG)
        with pytest.raises(GameHung, match=f"a game of hanging did not end within {HASTY:g} s"):
            await hung
        with pytest.raises(NotReady):  # the hang is not cached
            await pool.submit(request, 0.0)

    asyncio.run(both())


def is_playable_in_time(pool: GameWorkerPool, league: str) -> bool:
    """Whether the process of a hasty league has imported all that its games need. What was interrupted is repeated."""
    try:
        return bool(document_of(submit(pool, PlayabilityRequest(), league))["playable"])
    except (GameHung, GameCrashed):
        return False


def test_native_code_that_does_not_return_ends_the_process(pool: GameWorkerPool) -> None:
    until(lambda: is_playable_in_time(pool, "blockingsignals"))
    with pytest.raises(GameHung, match=f"its process was killed after {HASTY + GRACE:g} s"):
        submit(pool, play_request(0, opponent="script:random"), "blockingsignals")
    until(lambda: is_playable_in_time(pool, "blockingsignals"))


def test_a_process_that_dies_is_reported_and_replaced(pool: GameWorkerPool, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> NoReturn:
        raise OSError(errno.EAGAIN, "no more processes")

    with pytest.raises(WorkerLost, match="plays games of dying died"):
        submit(pool, play_request(0, opponent="script:random"), "dying")
    with monkeypatch.context() as patched:
        patched.setattr(subprocesses, "Subprocess", fail)
        with pytest.raises(OSError, match="no more processes"):
            submit(pool, PlayabilityRequest(), "dying")
    assert document_of(submit(pool, PlayabilityRequest(), "dying"))["playable"]
    os.kill(process_of(pool, "dying"), signal.SIGKILL)
    assert document_of(submit(pool, play_request(opponent="script:random"), "dying"))["legal"]


def test_an_exception_of_the_environment_is_reported_and_the_next_game_is_independent(
    registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[Raising] = []
    monkeypatch.setattr(Raising, "close", lambda environment: opened.remove(environment))
    create = Raising.__init__

    def open_(environment: Raising, **kwargs: Any) -> None:
        create(environment, **kwargs)
        opened.append(environment)

    monkeypatch.setattr(Raising, "__init__", open_)
    worker = GameWorker("raising", registry)
    for _ in range(2):
        with pytest.raises(GameCrashed, match="the board is gone"):
            worker.respond(play_request(0, opponent="script:random"))
        assert opened == [], "it is closed"
    assert document_of(worker.respond(play_request(opponent="script:random")))["legal"] == list(range(9))
    worker.close()
    assert opened == []


def test_a_changed_environment_is_used_for_the_next_game(registry: Registry) -> None:
    """Also after one that cannot be created, which is a server error."""
    worker = GameWorker("moving", registry)

    def play(entry_point: str) -> GameResponse:
        config = tictactoe.config(league="moving", environment={"entry_point": entry_point})
        registry.leagues.register(config, registry.leagues.get(LEAGUE).interface)
        return worker.respond(play_request(0, opponent="script:first"))

    with pytest.raises(GameCrashed, match=r"the environment of moving cannot be created: .*games\.none"):
        play("games.none:none")
    assert len(document_of(play("pettingzoo.classic.tictactoe_v3"))["steps"]) == 3
    with pytest.raises(GameCrashed, match="the board is gone"):
        play("tests.support.environments.hanging:Raising")


def test_idle_leagues_are_evicted_but_not_during_a_game(registry: Registry) -> None:
    with closing(GameWorkerPool(most=1)) as pool:

        async def submit_several() -> int:
            playing = asyncio.create_task(pool.submit(game_request(PlayabilityRequest(), "raising"), LONG))
            await asyncio.sleep(0)
            with pytest.raises(Overloaded, match="all 1 processes for games are in use by other leagues"):
                await pool.submit(game_request(PlayabilityRequest()), LONG)
            await playing
            process = process_of(pool, "raising")
            with pytest.raises(NotReady):
                await pool.submit(game_request(PlayabilityRequest()), 0.0)
            return process

        process = Path(f"/proc/{asyncio.run(submit_several())}")
        until(lambda: not process.exists())


def test_few_requests_may_wait(pool: GameWorkerPool, pause: threading.Event, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(game_worker_pool, "MOST_WAITING", 2)

    async def submit_many() -> None:
        first, second, third = (game_request(play_request(seed=seed)) for seed in range(3))
        waiting = [asyncio.create_task(pool.submit(request, LONG)) for request in (first, second)]
        await asyncio.sleep(0)
        with pytest.raises(Overloaded):
            await pool.submit(third, LONG)
        pause.set()
        await asyncio.gather(*waiting)

    asyncio.run(submit_many())


def test_only_leagues_with_discrete_actions_are_playable(registry: Registry) -> None:
    kwargs = {"max_cycles": 4, "continuous_actions": True}
    environment = {"entry_point": "mpe2.simple_spread_v3", "kwargs": kwargs}
    config = tictactoe.config(league="spread", environment=environment, play={"opening_plies": 0})
    registry.leagues.register(config, interface(config))
    worker = GameWorker("spread", registry)
    document = document_of(worker.respond(PlayabilityRequest()))
    assert (document["playable"], document["agents"]) == (False, [])
    assert document["why"] == "human play needs Discrete actions, but its agents have Box"
    with pytest.raises(EnvironmentMismatch, match="agent_0 has Box"):
        worker.respond(play_request(opponent="script:random", agent="agent_0"))
