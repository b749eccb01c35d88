"""Nights of training with a trainer that publishes handwritten versions."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock

from evaluation.gating.training_night import training_night
from league.config.league import LeagueConfig
from league.errors import AlreadyRunning, ConfigError
from league.refs import CheckpointRef
from league.registry.aliases import ANY
from league.registry.registry import Registry
from league.results.ledger import Ledger
from league.settings import Storage
from tests.support.crashes import ProcessDeath, crash_after
from tests.support.leagues import tictactoe
from tests.support.leagues.handwritten_training import HandwrittenTrainer
from tests.support.leagues.judged_league import MIDDLING, STRONG, STRONGEST, WEAK, league_of
from tests.support.policies.graphs import masked_mlp

GATE = {"elo1": 150, "max_blocks": 100, "confirmation_blocks": 4, "exploiters": {"blocks": 4}}
CONFIG = tictactoe.config(gate=GATE, play={"opening_plies": 2, "num_envs": 32})
LEAGUE = tictactoe.LEAGUE


@pytest.fixture(autouse=True)
def few_matches(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("evaluation.gating.nightly.RATING_BLOCKS", 4)


def trainer_of(registry: Registry, *graphs: bytes) -> HandwrittenTrainer:
    """A trainer that publishes the next graph for each new run."""
    return HandwrittenTrainer(registry, lambda number, _: graphs[number])


def state(registry: Registry) -> dict[str, Any]:
    """All data that a night leaves, without times."""
    return {
        "versions": [(row.number, row.role, row.exploits) for row in registry.versions.all(LEAGUE)],
        "matches": Ledger(registry).matches(league=LEAGUE),
        "verdicts": [(row.id, row.outcome) for row in registry.verdicts.all(LEAGUE)],
        "champions": [(event.version, event.previous) for event in registry.aliases.history(LEAGUE)],
        "nights": [
            (night.parent, _without_runs(night.steps), night.ended_at is None)
            for night in registry.training_nights.all(LEAGUE)
        ],
    }


def _without_runs(steps: dict[str, Any]) -> dict[str, Any]:
    """Ids of runs contain the time."""
    return {step: {key: value for key, value in result.items() if key != "run"} for step, result in steps.items()}


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    opened = league_of(tmp_path / "home", config=CONFIG)
    yield opened
    opened.close()


def test_a_night_trains_gates_and_measures_the_champion(registry: Registry) -> None:
    trainer = trainer_of(registry, STRONG, STRONGEST)
    announced: list[str] = []
    night, report = training_night(CONFIG, registry=registry, train=trainer, announce=announced.append)
    assert trainer.calls == [(night.run, None, None), (night.exploiter_run, 1, "tictactoe@1")]
    assert report is not None
    assert report.champion == "tictactoe@1"
    assert night.ended_at is not None
    assert night.steps["train"]["versions"] == ["tictactoe@1"]
    gate = night.steps["gate"]
    assert (gate["champion_before"], gate["champion"]) == (None, "tictactoe@1")
    assert gate["verdicts"] == [{"candidate": "tictactoe@1", "opponent": "script:random", "outcome": "promote"}]
    assert night.steps["exploiter"]["versions"] == ["tictactoe@2"]
    measured = night.steps["measure"]["exploitability"]
    assert (measured["ref"], measured["exploiters"][0]["ref"]) == ("tictactoe@1", "tictactoe@2")
    assert [line.partition("step ")[2] for line in announced] == [
        "1 of 4: train",
        "2 of 4: gate",
        "3 of 4: exploiter",
        "4 of 4: measure",
    ]


def test_a_champion_that_stays_keeps_its_exploiter_and_its_measurement(registry: Registry) -> None:
    trainer = trainer_of(registry, STRONG, STRONGEST, WEAK)
    first, _ = training_night(CONFIG, registry=registry, train=trainer)
    second, _ = training_night(CONFIG, registry=registry, train=trainer)
    assert trainer.calls[2:] == [(second.run, 1, None)]
    assert second.steps["gate"]["champion"] == "tictactoe@1"
    assert second.steps["measure"] == first.steps["measure"]


def test_a_champion_that_stays_is_measured_again_under_other_conditions(registry: Registry) -> None:
    trainer = trainer_of(registry, STRONG, STRONGEST, WEAK)
    training_night(CONFIG, registry=registry, train=trainer)
    sampled = CONFIG.model_copy(update={"play": CONFIG.play.model_copy(update={"actions": "sampled"})})
    registry.leagues.register(sampled, registry.leagues.get(LEAGUE).interface)
    night, _ = training_night(sampled, registry=registry, train=trainer)
    assert night.steps["exploiter"]["versions"] == ["tictactoe@2"]
    played = Ledger(registry).matches(league=LEAGUE)
    challenges = {each.schedule for each in played if {*each.contestants} == {"tictactoe@1", "tictactoe@2"}}
    actions = {Ledger(registry).schedule(each).conditions.actions for each in challenges}
    assert actions == {"greedy", "sampled"}


def test_an_exploiter_that_was_removed_is_replaced(registry: Registry) -> None:
    trainer = trainer_of(registry, STRONG, STRONGEST, WEAK, STRONGEST)
    training_night(CONFIG, registry=registry, train=trainer)
    registry.removal.remove_version(CheckpointRef(LEAGUE, 2), force=True)
    night, _ = training_night(CONFIG, registry=registry, train=trainer)
    assert night.steps["exploiter"]["versions"] == ["tictactoe@4"]
    assert night.steps["measure"]["exploitability"]["exploiters"][0]["ref"] == "tictactoe@4"


def test_the_steps_of_a_night_are_in_order(registry: Registry) -> None:
    night, _ = training_night(CONFIG, registry=registry, train=trainer_of(registry, STRONG, STRONGEST))
    assert list(night.steps) == ["train", "gate", "exploiter", "measure"]


def test_a_champion_that_changes_during_training_is_the_opponent_of_the_gate(registry: Registry) -> None:
    for graph in (WEAK, MIDDLING):
        tictactoe.publish(registry, graph)
    registry.aliases.set(LEAGUE, "champion", 1, expected=None, actor="me", reason="test")

    def promote_meanwhile(number: int, _: object) -> bytes:
        if number == 2:
            registry.aliases.set(LEAGUE, "champion", 2, expected=1, actor="me", reason="meanwhile")
        return STRONGEST

    night, report = training_night(CONFIG, registry=registry, train=HandwrittenTrainer(registry, promote_meanwhile))
    assert night.parent == 1, "training began from the champion of that time"
    assert night.steps["gate"]["champion_before"] == "tictactoe@1", "the one at the beginning of the night"
    assert night.steps["gate"]["verdicts"][-1] == {
        "candidate": "tictactoe@3", "opponent": "tictactoe@2", "outcome": "promote"
    }  # fmt: skip
    assert report is not None
    assert report.champion == "tictactoe@3"
    assert night.steps["exploiter"]["versions"] == ["tictactoe@4"]


def test_an_algorithm_without_opponents_trains_no_exploiter(registry: Registry) -> None:
    announced: list[str] = []
    night, _ = training_night(
        tictactoe.config(gate=GATE, play={"opening_plies": 2, "num_envs": 32}, training={"algorithm": "maddpg"}),
        registry=registry,
        train=(trainer := trainer_of(registry, STRONG)),
        announce=announced.append,
    )
    assert len(trainer.calls) == 1
    assert "tictactoe: maddpg does not support opponents, so tictactoe@1 gets no exploiter" in announced
    assert night.steps["exploiter"] == {"target": "tictactoe@1", "versions": []}
    assert night.steps["measure"] == {"target": "tictactoe@1", "exploitability": None}


def test_failed_training_is_recorded_and_the_night_goes_on(registry: Registry) -> None:
    tictactoe.publish(registry, STRONG)

    def fail(*_: object, **__: object) -> None:
        raise ConfigError("no such opponent")

    night, report = training_night(CONFIG, registry=registry, train=fail)
    assert night.parent == 1, "the newest version, without a champion"
    assert night.steps["train"] == {"run": night.run, "versions": [], "error": "no such opponent"}
    assert night.start == 1
    assert report is not None
    assert report.champion == "tictactoe@1"
    assert night.steps["exploiter"]["error"] == "no such opponent"
    assert night.steps["measure"]["exploitability"] is None


def test_a_night_continues_the_likeliest_member_and_tests_against_the_mixture(registry: Registry) -> None:
    for graph in (STRONG, WEAK):
        tictactoe.publish(registry, graph)
    number = registry.publisher.publish_mixture(LEAGUE, {1: 0.8, 2: 0.2}).number
    registry.aliases.set(LEAGUE, "champion", number, expected=ANY, actor="me", reason="test")
    trainer = HandwrittenTrainer(registry, lambda *_: WEAK)
    night, _ = training_night(CONFIG, registry=registry, train=trainer)
    assert (night.parent, trainer.calls[0][1], night.steps["train"]["start"], night.start) == (3, 1, 1, 1)
    assert night.steps["gate"]["champion_before"] == "tictactoe@3"
    assert night.steps["gate"]["verdicts"][0]["opponent"] == "tictactoe@3"
    assert {verdict["candidate"] for verdict in night.steps["gate"]["verdicts"]} == {
        f"tictactoe@{n}" for n in (1, 2, 4)
    }
    played = [match for match in Ledger(registry).matches(league=LEAGUE) if "tictactoe@3" in match.contestants]
    assert {member for match in played for game in match.games for member in game.members} == {1, 2, None}


def test_a_night_continues_the_version_that_a_champion_searches_with(registry: Registry) -> None:
    value = masked_mlp((3, 3, 2), 9, has_value=True)
    base = tictactoe.publish(registry, masked_mlp((3, 3, 2), 9), value=value)
    number = registry.publisher.publish_search(LEAGUE, base.number, "puct", 8, 1.0).number
    registry.aliases.set(LEAGUE, "champion", number, expected=ANY, actor="me", reason="test")
    trainer = HandwrittenTrainer(registry, lambda *_: WEAK)
    night, _ = training_night(CONFIG, registry=registry, train=trainer)
    assert (night.parent, trainer.calls[0][1], night.start) == (number, base.number, base.number)
    assert [verdict["opponent"] for verdict in night.steps["gate"]["verdicts"]] == [f"tictactoe@{number}"]


def test_the_trainer_decides_where_a_night_starts(registry: Registry) -> None:
    """As with an imported champion, which cannot be trained further."""
    tictactoe.publish(registry, STRONG)
    inner = HandwrittenTrainer(registry, lambda *_: WEAK)

    def from_scratch(config: LeagueConfig, *, name: str, parent: int | None, target: str | None) -> None:
        inner(config, name=name, parent=None, target=target)

    night, _ = training_night(CONFIG, registry=registry, train=from_scratch)
    assert (night.parent, night.steps["train"]["start"], night.start) == (1, None, None)


def test_a_run_in_another_process_leaves_the_night_open(registry: Registry) -> None:
    def busy(*_: object, **__: object) -> None:
        raise AlreadyRunning("training run x is running in another process")

    with pytest.raises(AlreadyRunning):
        training_night(CONFIG, registry=registry, train=busy)
    (night,) = registry.training_nights.all(LEAGUE)
    assert (night.steps, night.ended_at) == ({}, None)


def test_the_budget_of_an_exploiter_is_a_fraction_of_the_nights() -> None:
    config = tictactoe.config(
        training={"steps": 1000, "minutes": 9},
        nightly={"minutes": 4, "exploiter": 0.25, "opponents": [{"ref": "script:random", "share": 0.5}]},
    )
    main, exploiter = config.of_night(7).training, config.of_night(8, config.nightly.exploiter).training
    assert (main.seed, main.minutes, main.steps, main.checkpoint_every) == (7, 4, 1000, "auto")
    assert (exploiter.seed, exploiter.minutes, exploiter.steps, exploiter.checkpoint_every) == (8, 1, 250, None)
    assert [each.ref for each in main.opponents.fixed] == ["script:random"]


def test_the_default_number_of_steps_limits_a_night_without_limits_only() -> None:
    unlimited = tictactoe.config(training={}, nightly={"exploiter": 0.25})
    assert [unlimited.of_night(7, share).training.max_steps for share in (None, 0.25)] == [1_000_000, 250_000]
    in_minutes = tictactoe.config(training={}, nightly={"minutes": 4})
    assert in_minutes.of_night(7).training.max_steps is None


@pytest.mark.slow
def test_a_night_that_died_after_any_transaction_continues(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    league_of(tmp_path / "fresh", MIDDLING, config=CONFIG).close()

    def run(registry: Registry) -> None:
        training_night(CONFIG, registry=registry, train=trainer_of(registry, MIDDLING, STRONG, STRONGEST))

    quiet = _copy(tmp_path / "fresh", tmp_path / "quiet")
    with crash_after(0, monkeypatch) as count:
        run(quiet)
    expected, writes = state(quiet), count[0]
    assert writes > 15
    assert len(expected["versions"]) == 3
    skipped: list[int] = []
    for crash_at in range(writes, 0, -1):
        registry = _copy(tmp_path / "fresh", tmp_path / str(crash_at))
        with crash_after(crash_at, monkeypatch), pytest.raises(ProcessDeath):
            run(registry)
        if registry.training_nights.all(LEAGUE) == [] or registry.training_nights.all(LEAGUE)[0].ended_at is None:
            run(registry)
        found = state(registry)
        assert outline(found) == outline(expected), f"after transaction {crash_at}"
        if numbers(found) == numbers(expected):
            assert found == expected, f"after transaction {crash_at}"
        else:
            skipped.append(crash_at)
        registry.close()
    assert len(skipped) <= 2, "two versions are published, and only a publication that died skips its number"


def numbers(found: dict[str, Any]) -> list[int]:
    return [number for number, _, _ in found["versions"]]


def outline(found: dict[str, Any]) -> dict[str, Any]:
    """What a night leaves, without what depends on the numbers of versions."""
    return {
        "roles": [role for _, role, _ in found["versions"]],
        "outcomes": [outcome for _, outcome in found["verdicts"]],
        "promotions": len(found["champions"]),
        "nights": [(parent, list(steps), is_open) for parent, steps, is_open in found["nights"]],
    }


def _copy(home: Path, to: Path) -> Registry:
    shutil.copytree(home, to)
    return Registry.open(Storage.at(to))


def test_a_night_waits_for_another_nightly_run(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("evaluation.gating.training_night.WAIT", 0.01)
    other = FileLock(registry.storage.home / "locks" / f"nightly-{LEAGUE}.lock")
    said: list[str] = []

    def announce(sentence: str) -> None:
        said.append(sentence)
        if sentence.endswith("waiting until it ends"):
            other.release()

    other.acquire()
    night, report = training_night(
        CONFIG, registry=registry, train=trainer_of(registry, STRONG, STRONGEST), announce=announce
    )
    assert report is not None
    assert set(night.steps) == {"train", "gate", "exploiter", "measure"}
    assert sum("another process is running" in each for each in said) == 1
