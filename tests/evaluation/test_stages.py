"""Processes that play for people: each answers for its league, and what becomes of it is nobody else's trouble."""

from __future__ import annotations

import asyncio
import json
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from evaluation import stages
from evaluation.stages import Answer, Stages
from evaluation.tournament import evaluate
from league.environments.building import interface
from league.errors import (
    EnvironmentMismatch,
    GameCrashed,
    GameHung,
    IllegalAction,
    NotReady,
    Overloaded,
    UnknownVersion,
    WorkerLost,
)
from league.games import Film, Order, Recording, Sitting, Table
from league.registry.registry import Registry
from league.results.ledger import Ledger
from tests.evaluation import examples
from tests.evaluation.examples import LEAGUE

LONG = 120.0


@pytest.fixture(scope="module")
def registry(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Registry]:
    """Tic-tac-toe with a version and a match; leagues whose first move hangs, raises or ends the process."""
    opened = examples.registry(tmp_path_factory.mktemp("stages") / "home")
    examples.publish(opened, examples.graph(wins=True))
    evaluate(LEAGUE, ["tictactoe@1", "script:random"], registry=opened, blocks=1)
    for name in ("Hanging", "Raising", "Dying", "Deaf"):
        config = examples.config(league=name.lower(), environment={"entry_point": f"tests.evaluation.hanging:{name}"})
        opened.register(config, interface(config))
    with pytest.MonkeyPatch.context() as patch:
        for name, value in (
            ("LEAGUE_HOME", opened.storage.home),
            ("LEAGUE_DATABASE_URL", opened.storage.database_url),
            ("LEAGUE_ARTIFACTS", opened.storage.artifacts),
        ):
            patch.setenv(name, str(value))
        yield opened
    opened.close()


@contextmanager
def at_work(**settings: Any) -> Iterator[Stages]:
    working = Stages(**settings)
    try:
        yield working
    finally:
        working.close()


@pytest.fixture(scope="module")
def shared(registry: Registry) -> Iterator[Stages]:
    with at_work() as working:
        yield working


def order(asked: Any, league: str = LEAGUE) -> Order:
    return Order(league=league, environment="digest", asked=asked)


def ask(working: Stages, asked: Any, league: str = LEAGUE, patience: float = LONG) -> Answer:
    return asyncio.run(working.ask(order(asked, league), patience))


def sitting(*actions: int, opponent: str = "tictactoe@1", agent: str = "player_1", seed: int = 0) -> Sitting:
    return Sitting(opponent=opponent, agent=agent, actions=actions, seed=seed, chances=True)


def told(answer: Answer) -> dict[str, Any]:
    assert answer.media_type == "application/json"
    return dict(json.loads(answer.content))


def children() -> list[int]:
    """The stages of this process."""
    paths = Path(f"/proc/{os.getpid()}/task").glob("*/children")
    found = [int(child) for path in paths for child in path.read_text().split()]
    return [child for child in found if b"evaluation.stage" in Path(f"/proc/{child}/cmdline").read_bytes()]


def test_it_tells_who_may_play(shared: Stages) -> None:
    assert told(ask(shared, Table())) == {
        "league": LEAGUE,
        "playable": True,
        "why": None,
        "agents": [{"agent": f"player_{i}", "side": f"player_{i}", "actions": 9, "start": 0} for i in (1, 2)],
        "opponents": ["tictactoe@1", "script:random", "script:one_ply"],
        "draws": True,
    }


def test_a_recorded_game_comes_with_pictures_and_as_a_film(shared: Stages, registry: Registry) -> None:
    match = Ledger(registry).matches(league=LEAGUE)[0]
    book = told(ask(shared, Recording(match=match.id, game=1, first=1, end=3)))
    assert [step["step"] for step in book["steps"]] == [1, 2]
    assert all(step["picture"].startswith("data:image/png;base64,") for step in book["steps"])
    film = ask(shared, Film(match=match.id, game=1))
    assert film.media_type == "image/gif"
    assert Image.open(BytesIO(film.content)).n_frames == book["length"] + 1


def test_a_game_against_a_version_is_played(shared: Stages) -> None:
    sat = told(ask(shared, sitting(4)))
    assert [step["moves"][0]["action"] for step in sat["steps"][1:]] == [4, sat["steps"][2]["moves"][0]["action"]]
    assert sat["picture"].startswith("data:image/png;base64,")
    assert sat["chances"][0][0] in sat["legal"]
    assert len(children()) == 1, "one league, one process"


def test_errors_arrive_as_themselves(shared: Stages) -> None:
    for asked, error, words in (
        (sitting(4, 4), IllegalAction, "4, number 2 of them"),
        (sitting(opponent="tictactoe@9"), UnknownVersion, "tictactoe"),
        (Film(match="nowhere/0", game=0), stages.BY_CODE["not_found"], "nowhere"),
    ):
        with pytest.raises(error, match=words):
            ask(shared, asked)


def test_what_was_answered_is_kept_but_not_what_may_change(shared: Stages) -> None:
    assert ask(shared, sitting(4)) is ask(shared, sitting(4))
    assert ask(shared, Table()) is not ask(shared, Table())


def test_an_order_that_takes_long_is_asked_for_again(registry: Registry) -> None:
    with at_work() as working:

        async def patiently() -> tuple[int, Answer]:
            tries = 0
            while True:
                try:
                    return tries, await working.ask(order(sitting(0)), patience=0.05)
                except NotReady:
                    tries += 1

        tries, answer = asyncio.run(patiently())
    assert tries > 0, "a process does not start in 50 ms"
    assert told(answer)["over"] is False


def test_one_that_hangs_is_given_up_and_others_are_played_meanwhile(registry: Registry) -> None:
    with at_work(seconds=4.0) as working:

        async def both() -> None:
            hung = asyncio.create_task(working.ask(order(sitting(0, opponent="script:random"), "hanging"), LONG))
            await working.ask(order(sitting(0)), LONG)
            with pytest.raises(GameHung, match="a game of hanging was not at its end after 4 s"):
                await hung
            with pytest.raises(NotReady):  # it is not kept that it hung
                await working.ask(order(sitting(0, opponent="script:random"), "hanging"), 0.01)

        asyncio.run(both())


def test_native_code_that_never_comes_back_costs_the_process(registry: Registry) -> None:
    with at_work(seconds=4.0, grace=2.0) as working:
        with pytest.raises(GameHung, match="its process was ended after 6 s"):
            ask(working, sitting(0, opponent="script:random"), "deaf")
        assert told(ask(working, Table(), "deaf"))["playable"]


def test_a_process_that_dies_is_told_and_replaced(registry: Registry) -> None:
    with at_work() as working:
        with pytest.raises(WorkerLost, match="plays games of dying died"):
            ask(working, sitting(0, opponent="script:random"), "dying")
        assert told(ask(working, Table(), "dying"))["playable"]
        (process,) = children()[-1:]
        os.kill(process, signal.SIGKILL)
        assert told(ask(working, sitting(opponent="script:random"), "dying"))["legal"]


def test_what_an_environment_raises_is_told_and_the_next_game_has_a_fresh_one(shared: Stages) -> None:
    for _ in range(2):
        with pytest.raises(GameCrashed, match="the board is gone"):
            ask(shared, sitting(0, opponent="script:random"), "raising")
    assert told(ask(shared, sitting(opponent="script:random"), "raising"))["legal"] == list(range(9))


def test_an_environment_that_cannot_be_made_is_no_fault_of_who_asks(shared: Stages, registry: Registry) -> None:
    lost = examples.config(league="lost", environment={"entry_point": "games.none:none"})
    registry.register(lost, registry.league(LEAGUE).interface)
    with pytest.raises(GameCrashed, match=r"the environment of lost cannot be made: .*games\.none"):
        ask(shared, Table(), "lost")


def test_a_league_that_gets_another_environment_is_played_in_that_one(registry: Registry) -> None:
    league = examples.config(league="moving")
    registry.register(league, interface(league))
    with at_work() as working:
        asked = sitting(0, opponent="script:first")
        assert len(told(ask(working, asked, "moving"))["steps"]) == 3
        other = examples.config(league="moving", environment={"entry_point": "tests.evaluation.hanging:Raising"})
        registry.register(other, interface(other))
        with pytest.raises(GameCrashed):
            asyncio.run(working.ask(Order(league="moving", environment="another", asked=asked), LONG))


def test_leagues_make_way_for_others_but_not_in_the_middle_of_a_game(registry: Registry) -> None:
    with at_work(most=1, seconds=4.0) as working:

        async def ask_several() -> None:
            hung = asyncio.create_task(working.ask(order(sitting(0, opponent="script:random"), "hanging"), LONG))
            await asyncio.sleep(0)
            with pytest.raises(Overloaded, match="games of 1 other leagues are being played"):
                await working.ask(order(Table()), LONG)
            with pytest.raises(GameHung):
                await hung
            await working.ask(order(Table()), LONG)

        before = children()
        asyncio.run(ask_several())
        assert len(set(children()) - set(before)) == 1


def test_no_more_wait_than_are_allowed(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stages, "MOST_WAITING", 2)
    with at_work() as working:

        async def many() -> list[Any]:
            asked = [working.ask(order(sitting(seed=seed)), LONG) for seed in range(3)]
            return list(await asyncio.gather(*asked, return_exceptions=True))

        *answered, refused = asyncio.run(many())
    assert all(isinstance(each, Answer) for each in answered)
    assert isinstance(refused, Overloaded)


def test_no_more_is_kept_than_there_is_room_for(shared: Stages, monkeypatch: pytest.MonkeyPatch) -> None:
    first = ask(shared, sitting(1))
    monkeypatch.setattr(stages, "ROOM", len(first.content))
    ask(shared, sitting(2))
    ask(shared, sitting(3))
    assert ask(shared, sitting(1)) is not first


def test_only_leagues_in_which_agents_choose_are_playable(registry: Registry, shared: Stages) -> None:
    config = examples.config(
        league="spread",
        environment={
            "entry_point": "mpe2.simple_spread_v3",
            "kwargs": {"max_cycles": 4, "continuous_actions": True},
        },
        play={"opening_plies": 0},
    )
    registry.register(config, interface(config))
    document = told(ask(shared, Table(), "spread"))
    assert (document["playable"], document["agents"]) == (False, [])
    assert document["why"] == "its agents act by Box: a person chooses one of several actions"
    with pytest.raises(EnvironmentMismatch, match="agent_0 acts by Box"):
        ask(shared, sitting(opponent="script:random", agent="agent_0"), "spread")
