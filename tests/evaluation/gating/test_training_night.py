"""Nights of training, and tests of exploitability, with a trainer that publishes handwritten versions."""

from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock

from evaluation.gating.evidence import VerdictReport, verdict_of
from evaluation.gating.nightly import nightly
from evaluation.gating.trained_exploiters import trained_exploiters
from evaluation.gating.training_night import training_night
from evaluation.gating.verdicts import conclude, open_verdict
from evaluation.gating.verification import verify
from league.config.league import LeagueConfig
from league.config.off_policy import MADDPGConfig
from league.errors import AlreadyRunning, ConfigError, ExploiterMissing
from league.refs import CheckpointRef
from league.registry.registry import Registry
from league.registry.verdicts import VOID
from league.results.ledger import Ledger
from league.settings import Storage
from policy_league.cli import output
from tests.support.crashes import ProcessDeath, after_crashes
from tests.support.leagues import tictactoe
from tests.support.leagues.handwritten_training import HandwrittenTrainer
from tests.support.leagues.judged_league import (
    MIDDLING,
    STRONG,
    STRONGEST,
    WEAK,
    config,
    league_of,
    promote,
    reconfigure,
)
from tests.support.leagues.tictactoe import LEAGUE
from tests.support.policies.graphs import masked_mlp
from training.algorithms.resources import Resources

GATE = {"elo1": 150, "max_blocks": 100, "confirmation_blocks": 4, "exploiters": {"blocks": 4}}
CONFIG = config(**GATE)
ANY_CANDIDATE = {"model": "logistic", "elo0": -2000, "elo1": -1500}
"""Hypotheses so low that a weaker candidate passes the test against the champion."""
IMPROVEMENT = {"count": 1, "blocks": 20, "improvement": 0.1}


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
    with closing(league_of(tmp_path / "home", config=CONFIG)) as opened:
        yield opened


def fail(*_: object, **__: object) -> None:
    raise ConfigError("no such opponent")


def test_a_night_trains_gates_and_measures_the_champion(registry: Registry) -> None:
    trainer, announced = trainer_of(registry, STRONG, STRONGEST), list[str]()
    night, report = training_night(CONFIG, registry=registry, train=trainer, announce=announced.append)
    assert trainer.calls == [(night.run, None, None), (night.exploiter_run, 1, "tictactoe@1")]
    assert (report.champion, list(night.steps)) == ("tictactoe@1", ["train", "gate", "exploiter", "measure"])
    assert night.ended_at is not None
    assert night.steps["train"]["versions"] == ["tictactoe@1"]
    gate = night.steps["gate"]
    assert (gate["champion_before"], gate["champion"]) == (None, "tictactoe@1")
    assert gate["verdicts"] == [{"candidate": "tictactoe@1", "opponent": "script:random", "outcome": "promote"}]
    assert night.steps["exploiter"]["versions"] == ["tictactoe@2"]
    measured = night.steps["measure"]["exploitability"]
    assert (measured["ref"], measured["exploiters"][0]["ref"]) == ("tictactoe@1", "tictactoe@2")
    steps = [line.partition("step ")[2] for line in announced]
    assert steps == ["1 of 4: train", "2 of 4: gate", "3 of 4: exploiter", "4 of 4: measure"]


def test_a_champion_that_stays_keeps_its_exploiter_and_its_measurement(registry: Registry) -> None:
    """It is measured again under other conditions, and gets another exploiter if its own was removed."""
    trainer = trainer_of(registry, STRONG, STRONGEST, WEAK, WEAK, WEAK, STRONGEST)
    first, _ = training_night(CONFIG, registry=registry, train=trainer)
    second, _ = training_night(CONFIG, registry=registry, train=trainer)
    assert trainer.calls[2:] == [(second.run, 1, None)]
    assert second.steps["gate"]["champion"] == "tictactoe@1"
    assert second.steps["measure"] == first.steps["measure"]
    sampled = CONFIG.model_copy(update={"play": CONFIG.play.model_copy(update={"actions": "sampled"})})
    reconfigure(registry, sampled)
    night, _ = training_night(sampled, registry=registry, train=trainer)
    assert night.steps["exploiter"]["versions"] == ["tictactoe@2"]
    played = Ledger(registry).matches(league=LEAGUE)
    challenges = {match.schedule for match in played if {*match.contestants} == {"tictactoe@1", "tictactoe@2"}}
    assert {Ledger(registry).schedule(name).conditions.actions for name in challenges} == {"greedy", "sampled"}
    registry.removal.remove_version(CheckpointRef(LEAGUE, 2), force=True)
    night, _ = training_night(CONFIG, registry=registry, train=trainer)
    assert night.steps["exploiter"]["versions"] == ["tictactoe@6"]
    assert night.steps["measure"]["exploitability"]["exploiters"][0]["ref"] == "tictactoe@6"


def test_a_champion_that_changes_during_training_is_the_opponent_of_the_gate(registry: Registry) -> None:
    for graph in (WEAK, MIDDLING):
        tictactoe.publish(registry, graph)
    promote(registry, 1)

    def promote_meanwhile(number: int, _: object) -> bytes:
        if number == 2:
            promote(registry, 2)
        return STRONGEST

    night, report = training_night(CONFIG, registry=registry, train=HandwrittenTrainer(registry, promote_meanwhile))
    assert night.parent == 1, "training began from the champion of that time"
    assert night.steps["gate"]["champion_before"] == "tictactoe@1", "the one at the beginning of the night"
    last = {"candidate": "tictactoe@3", "opponent": "tictactoe@2", "outcome": "promote"}
    assert night.steps["gate"]["verdicts"][-1] == last
    assert report.champion == "tictactoe@3"
    assert night.steps["exploiter"]["versions"] == ["tictactoe@4"]


def test_an_algorithm_without_opponents_trains_no_exploiter(registry: Registry) -> None:
    announced, trainer = list[str](), trainer_of(registry, STRONG)
    maddpg = CONFIG.model_copy(update={"training": MADDPGConfig(algorithm="maddpg")})
    night, _ = training_night(maddpg, registry=registry, train=trainer, announce=announced.append)
    assert len(trainer.calls) == 1
    assert "tictactoe: maddpg does not support opponents, so tictactoe@1 gets no exploiter" in announced
    assert night.steps["exploiter"] == {"target": "tictactoe@1", "versions": []}
    assert night.steps["measure"] == {"target": "tictactoe@1", "exploitability": None}


def test_failed_training_is_recorded_and_the_night_goes_on(registry: Registry) -> None:
    tictactoe.publish(registry, STRONG)
    night, report = training_night(CONFIG, registry=registry, train=fail)
    assert night.parent == night.start == 1, "the newest version, without a champion"
    assert night.steps["train"] == {"run": night.run, "versions": [], "error": "no such opponent"}
    assert report.champion == "tictactoe@1"
    assert night.steps["exploiter"]["error"] == "no such opponent"
    assert night.steps["measure"]["exploitability"] is None


def test_a_night_continues_the_likeliest_member_and_tests_against_the_mixture(registry: Registry) -> None:
    for graph in (STRONG, WEAK):
        tictactoe.publish(registry, graph)
    promote(registry, registry.publisher.publish_mixture(LEAGUE, {1: 0.8, 2: 0.2}).number)
    trainer = HandwrittenTrainer(registry, lambda *_: WEAK)
    night, _ = training_night(CONFIG, registry=registry, train=trainer)
    assert (night.parent, trainer.calls[0][1], night.steps["train"]["start"], night.start) == (3, 1, 1, 1)
    gate = night.steps["gate"]
    assert gate["champion_before"] == gate["verdicts"][0]["opponent"] == "tictactoe@3"
    assert {verdict["candidate"] for verdict in gate["verdicts"]} == {f"tictactoe@{n}" for n in (1, 2, 4)}
    played = [match for match in Ledger(registry).matches(league=LEAGUE) if "tictactoe@3" in match.contestants]
    assert {member for match in played for game in match.games for member in game.members} == {1, 2, None}


def test_a_night_continues_the_version_that_a_champion_searches_with(registry: Registry) -> None:
    value = masked_mlp((3, 3, 2), 9, has_value=True)
    base = tictactoe.publish(registry, masked_mlp((3, 3, 2), 9), value=value)
    number = registry.publisher.publish_search(LEAGUE, base.number, "puct", 8, 1.0).number
    trainer = HandwrittenTrainer(promote(registry, number), lambda *_: WEAK)
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
    """The default number of steps limits a night without limits only."""
    opponents = [{"ref": "script:random", "share": 0.5}]
    settings = tictactoe.config(
        training={"steps": 1000, "minutes": 9}, nightly={"minutes": 4, "exploiter": 0.25, "opponents": opponents}
    )
    main, exploiter = settings.of_night(7).training, settings.of_night(8, settings.nightly.exploiter).training
    assert (main.seed, main.minutes, main.steps, main.checkpoint_every) == (7, 4, 1000, "auto")
    assert (exploiter.seed, exploiter.minutes, exploiter.steps, exploiter.checkpoint_every) == (8, 1, 250, None)
    assert [opponent.ref for opponent in main.opponents.fixed] == ["script:random"]
    unlimited = tictactoe.config(training={}, nightly={"exploiter": 0.25})
    assert [unlimited.of_night(7, share).training.max_steps for share in (None, 0.25)] == [1_000_000, 250_000]
    assert tictactoe.config(training={}, nightly={"minutes": 4}).of_night(7).training.max_steps is None


@pytest.mark.slow
def test_a_night_that_died_after_any_transaction_continues(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    league_of(tmp_path / "fresh", MIDDLING, config=CONFIG).close()

    def run(registry: Registry) -> None:
        """Unless it has ended: then the next one would begin."""
        nights = registry.training_nights.all(LEAGUE)
        if nights == [] or nights[0].ended_at is None:
            training_night(CONFIG, registry=registry, train=trainer_of(registry, MIDDLING, STRONG, STRONGEST))

    runs = after_crashes(tmp_path / "fresh", run, 1, monkeypatch)
    writes, quiet = next(runs)
    expected = state(quiet)
    assert writes > 15
    assert len(expected["versions"]) == 3
    skipped: list[int] = []
    for crash_at, registry in runs:
        result = state(registry)
        assert outline(result) == outline(expected), f"after transaction {crash_at}"
        if numbers(result) == numbers(expected):
            assert result == expected, f"after transaction {crash_at}"
        else:
            skipped.append(crash_at)
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


def test_a_night_waits_for_another_nightly_run(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("evaluation.gating.training_night.WAIT", 0.01)
    other, said = FileLock(registry.storage.home / "locks" / f"nightly-{LEAGUE}.lock"), list[str]()

    def announce(sentence: str) -> None:
        said.append(sentence)
        if sentence.endswith("waiting until it ends"):
            other.release()

    other.acquire()
    trainer = trainer_of(registry, STRONG, STRONGEST)
    night, _ = training_night(CONFIG, registry=registry, train=trainer, announce=announce)
    assert set(night.steps) == {"train", "gate", "exploiter", "measure"}
    assert sum("another process is running" in sentence for sentence in said) == 1


def exploiting(count: int = 2, **gate: object) -> LeagueConfig:
    """A gate that trains this number of exploiters of candidate and champion."""
    few = {"max_blocks": 200, "earlier_champions": 0, "exploited_champions": 0, "confirmation_blocks": 0}
    exploiters = {"exploiter_margin": 0.2, "exploiters": {"count": count, "blocks": 20}}
    training = {"steps": 1000, "minutes": 4}
    play = {"opening_plies": 2, "num_envs": 32}
    return tictactoe.config(play=play, gate={"elo1": 150} | few | exploiters | gate, training=training)


def league(home: Path, settings: LeagueConfig, *graphs: bytes) -> Registry:
    """A league whose first version is its champion."""
    registry = league_of(home, *graphs, config=settings)
    reconfigure(registry, settings)
    return promote(registry, 1)


def strongest(registry: Registry) -> HandwrittenTrainer:
    return HandwrittenTrainer(registry, lambda _, target: STRONGEST if target else STRONG)


def verdict_on(registry: Registry, candidate: int, train: HandwrittenTrainer, opponent: int = 1) -> VerdictReport:
    row = open_verdict(registry, registry.leagues.get(LEAGUE), candidate, f"{LEAGUE}@{opponent}")
    return conclude(registry, row, train=train)


def test_a_candidate_that_is_not_more_exploitable_is_promoted(tmp_path: Path) -> None:
    registry = league(tmp_path, exploiting(), MIDDLING, STRONG)
    train = strongest(registry)
    report = verdict_on(registry, 2, train)
    assert report.promoted, report
    result = report.exploitability
    assert (result.ref, result.outcome, result.margin) == ("tictactoe@1", "not more exploitable", 0.2)
    assert result.games == result.blocks * 8, "two exploiters of each, and two games a block"
    assert sum(result.counts) == result.blocks
    assert sorted(score.ref for score in result.candidate.exploiters) == ["tictactoe@3", "tictactoe@4"]
    assert {score.games for score in (*result.candidate.exploiters, *result.champion.exploiters)} == {40}
    assert result.candidate.bound <= min(score.score for score in result.candidate.exploiters)
    candidate, champion = (sum(s.score for s in side.exploiters) / 2 for side in (result.candidate, result.champion))
    assert result.difference.mean == pytest.approx(candidate - champion)
    assert result.difference_over_exploiters.mean == pytest.approx(result.difference.mean)
    of_candidate, of_champion = [(2, "tictactoe@2")] * 2, [(1, "tictactoe@1")] * 2
    assert [(parent, target) for _, parent, target in train.calls] == of_candidate + of_champion
    assert len({name for name, _, _ in train.calls}) == 4
    reason = "is at most 0.2 more exploitable than tictactoe@1 by exploiters"
    assert reason in registry.aliases.history(LEAGUE)[0].reason
    assert verify(report.verdict, registry=registry, replays=8).replayed == 8


def test_a_candidate_that_is_less_exploitable_is_promoted_without_a_gain(tmp_path: Path) -> None:
    registry = league(tmp_path, exploiting(exploiters=IMPROVEMENT, **ANY_CANDIDATE), WEAK, STRONG)
    report = verdict_on(registry, 2, strongest(registry))
    assert report.promoted, report
    result = report.exploitability
    assert (result.outcome, result.improvement) == ("less exploitable", 0.1)
    assert result.difference.mean < -0.1
    reason = registry.aliases.history(LEAGUE)[0].reason
    assert reason.startswith("is not inferior to tictactoe@1 over ")
    assert reason.endswith(", and is less exploitable than tictactoe@1 by exploiters trained against each")
    assert verdict_of(registry, registry.verdicts.get(report.verdict)).reason.startswith("Not inferior: ")
    assert "; less exploitable than tictactoe@1 after " in output.verdict(report)
    verify(report.verdict, registry=registry, replays=4)


def test_a_candidate_that_is_not_less_exploitable_is_rejected(tmp_path: Path) -> None:
    registry = league(tmp_path, exploiting(exploiters=IMPROVEMENT, **ANY_CANDIDATE), STRONG, MIDDLING)
    report = verdict_on(registry, 2, strongest(registry))
    assert (report.outcome, report.promoted, report.exploitability.outcome) == (
        "reject",
        False,
        "not less exploitable",
    ), report
    assert report.note.startswith("it is not inferior to the champion, but is not less exploitable than tictactoe@1")


@pytest.mark.parametrize("run", [nightly, partial(training_night, train=lambda *_, **__: None)])
def test_exploiters_need_two_sides_and_an_algorithm_with_opponents(tmp_path: Path, run: Callable[..., object]) -> None:
    team = {"sides": {"team": ("player_1", "player_2")}}
    maddpg = {"training": MADDPGConfig(algorithm="maddpg")}
    with closing(Registry.open(Storage.at(tmp_path))) as registry:
        for settings, message in (
            (exploiting(exploiters=IMPROVEMENT).model_copy(update=team), "has one side only"),
            (
                exploiting().model_copy(update=maddpg),
                r"gate\.exploiters\.count: maddpg does not support opponents",
            ),
        ):
            with pytest.raises(ConfigError, match=message):
                run(settings, registry=registry)


def test_a_candidate_that_fails_another_test_costs_no_training(tmp_path: Path) -> None:
    registry = league(tmp_path, exploiting(), STRONG, WEAK)
    train = strongest(registry)
    assert verdict_on(registry, 2, train).exploitability is None
    assert train.calls == []


def test_each_verdict_trains_new_exploiters_of_both(tmp_path: Path) -> None:
    """A champion does not keep the luck of the exploiters with which it was promoted."""
    registry = league(tmp_path, exploiting(**ANY_CANDIDATE), STRONG, STRONG)
    train = strongest(registry)
    assert verdict_on(registry, 2, train).promoted
    tictactoe.publish(registry, STRONG)
    second = registry.versions.all(LEAGUE)[-1].number
    report = verdict_on(registry, second, train, opponent=2)
    assert [target for _, _, target in train.calls[4:]] == [f"tictactoe@{second}"] * 2 + ["tictactoe@2"] * 2
    runs = [registry.runs.get(LEAGUE, name) for name, _, _ in train.calls]
    seeds = [run.seed for run in runs]
    assert seeds == [seeds[0], seeds[1]] * 2 + [seeds[4], seeds[5]] * 2, "equal for candidate and champion"
    assert len(set(seeds)) == 4
    of_champion = {exploiter.ref for exploiter in report.exploitability.champion.exploiters}
    assert of_champion.isdisjoint({"tictactoe@3", "tictactoe@4"})


def test_exploiters_of_both_have_the_settings_of_the_league_now(tmp_path: Path) -> None:
    """The configuration changes after a failure: those that are complete are trained anew."""
    registry = league(tmp_path, exploiting(count=1), MIDDLING, STRONG)
    inner = strongest(registry)

    def fail_second(settings: LeagueConfig, *, name: str, parent: int | None, target: str | None) -> None:
        if target == "tictactoe@1":
            raise ConfigError("no such device")
        inner(settings, name=name, parent=parent, target=target)

    row = open_verdict(registry, registry.leagues.get(LEAGUE), 2, "tictactoe@1")
    with pytest.raises(ExploiterMissing):
        conclude(registry, row, train=fail_second)
    changed = exploiting(count=1).with_training(lr=0.01)
    reconfigure(registry, changed)
    assert conclude(registry, registry.verdicts.get(row.id), train=inner).promoted
    assert [target for _, _, target in inner.calls] == ["tictactoe@2", "tictactoe@2", "tictactoe@1"]
    settings = [registry.runs.get(LEAGUE, name).settings for name, _, _ in inner.calls[1:]]
    assert settings[0]["lr"] == settings[1]["lr"]
    assert settings[0]["seed"] == settings[1]["seed"]


def test_only_complete_runs_with_the_same_settings_count(tmp_path: Path) -> None:
    registry = league(tmp_path, exploiting(count=1), MIDDLING, STRONG)
    of_exploiter = exploiting().of_exploiter(0, 1000, 4, 0.15)
    budget = of_exploiter.training.model_dump(mode="json", by_alias=True)
    other_machine = Resources(runners=3, num_envs=7, threads=2, gpus=1.0, runner_gpus=0.5, learners=2, batch_scale=8)
    for run, settings in {
        "longer": budget | {"steps": 1000},
        "slower": budget | {"lr": 1e-5},
        "of_another_release": budget | {"momentum": 0.5},
        "stopped": budget,
        "equal": budget | other_machine.settings,
    }.items():
        registry.runs.begin(LEAGUE, run, algorithm="ppo", settings=settings, seed=0, target=100)
        tictactoe.publish(registry, STRONGEST, exploits="tictactoe@1", source=f"{run}/100", settings=settings)
        registry.runs.end(LEAGUE, run, "stopped" if run == "stopped" else "ended")
    exploiters = trained_exploiters(registry, registry.leagues.get(LEAGUE), "tictactoe@1", of_exploiter)
    assert exploiters == ["tictactoe@7"]


@pytest.mark.parametrize(
    ("steps", "minutes", "budget"),
    [(20_000, 10, (3000, 1.5)), (None, 10, (None, 1.5)), (None, None, (150_000, None))],
)
def test_the_budget_is_a_share_of_the_candidates_run(
    tmp_path: Path, steps: int | None, minutes: float | None, budget: tuple[int | None, float | None]
) -> None:
    registry = league(tmp_path, exploiting(count=1), MIDDLING)
    tictactoe.publish(registry, STRONG, settings={"steps": steps, "minutes": minutes})
    budgets, seeds = [], []

    def train(settings: LeagueConfig, *, name: str, parent: int | None, target: str | None) -> None:
        budgets.append((settings.training.steps, settings.training.minutes, settings.training.checkpoint_every))
        seeds.append(settings.training.seed)
        strongest(registry)(settings, name=name, parent=parent, target=target)

    row = open_verdict(registry, registry.leagues.get(LEAGUE), 2, "tictactoe@1")
    conclude(registry, row, train=train)
    assert budgets == [(*budget, None)] * 2
    assert seeds[0] == seeds[1]


def test_a_night_measures_all_exploiters_of_the_gate(tmp_path: Path) -> None:
    settings, graphs = exploiting(count=2, max_blocks=40), [STRONG, STRONGEST, WEAK, STRONGEST, STRONGEST]
    registry = league(tmp_path, settings, MIDDLING)
    train = HandwrittenTrainer(registry, lambda number, _: graphs[number - 1])
    night, report = training_night(settings, registry=registry, train=train)
    assert report.champion == "tictactoe@2"
    of_candidate, of_champion = ["tictactoe@2"] * 2, ["tictactoe@1"] * 2
    targets = [target for _, _, target in train.calls]
    assert targets == [None, *of_candidate, *of_champion], "those of the new champion are not trained twice"
    assert night.steps["exploiter"] == {"target": "tictactoe@2", "versions": ["tictactoe@3", "tictactoe@4"]}
    measured = night.steps["measure"]["exploitability"]["exploiters"]
    assert [score["ref"] for score in measured] == ["tictactoe@3", "tictactoe@4"], "the best one is the first"


def test_without_a_trainer_the_verdict_stays_open_and_continues(tmp_path: Path) -> None:
    settings = exploiting(count=1)
    registry = league(tmp_path, settings, MIDDLING, STRONG)
    report = nightly(settings, registry=registry)
    assert report.champion == "tictactoe@1"
    assert report.faults == (
        "tictactoe@2 against tictactoe@1: gate.exploiters requires an exploiter of tictactoe@2, which cannot be trained"
        " here: run `league nightly` on a machine with PyTorch",
    )
    resumed = nightly(settings, registry=registry, train=strongest(registry))
    assert (resumed.champion, resumed.faults) == ("tictactoe@2", ())
    assert [row.outcome for row in registry.verdicts.all(LEAGUE) if row.candidate == 2] == ["promote"]


def test_training_that_fails_or_dies_leaves_the_verdict_open_and_continues_with_the_same_run(tmp_path: Path) -> None:
    registry = league(tmp_path, exploiting(), MIDDLING, STRONG)
    row = open_verdict(registry, registry.leagues.get(LEAGUE), 2, "tictactoe@1")
    with pytest.raises(ExploiterMissing, match="exploiter of tictactoe@2 was not trained: no such opponent; the next"):
        conclude(registry, row, train=fail)
    with pytest.raises(ExploiterMissing, match="published no exploiter of tictactoe@2"):
        conclude(registry, row, train=lambda *_, **__: None)
    inner = strongest(registry)

    def die_third(settings: LeagueConfig, *, name: str, parent: int | None, target: str | None) -> None:
        if len(inner.calls) == 2:
            inner.calls.append((name, parent, target))
            raise ProcessDeath
        inner(settings, name=name, parent=parent, target=target)

    with pytest.raises(ProcessDeath):
        conclude(registry, row, train=die_third)
    assert conclude(registry, registry.verdicts.get(row.id), train=inner).promoted
    names = [name for name, _, _ in inner.calls]
    assert names[2] == names[3]
    assert len(set(names)) == 4


def test_a_verdict_that_is_voided_during_training_ends(tmp_path: Path) -> None:
    registry = league(tmp_path, exploiting(), MIDDLING, STRONG)
    row = open_verdict(registry, registry.leagues.get(LEAGUE), 2, "tictactoe@1")
    inner = strongest(registry)

    def train(settings: LeagueConfig, *, name: str, parent: int | None, target: str | None) -> None:
        inner(settings, name=name, parent=parent, target=target)
        registry.verdicts.void(row.id, "voided by me: test")

    report = conclude(registry, row, train=train)
    assert (report.outcome, report.exploitability, len(inner.calls)) == (VOID, None, 1)


def test_without_a_champion_nothing_is_compared(tmp_path: Path) -> None:
    registry = league_of(tmp_path, STRONG, config=exploiting())
    assert conclude(registry, open_verdict(registry, registry.leagues.get(LEAGUE), 1, "script:random")).promoted


@pytest.mark.slow
@pytest.mark.parametrize("improvement", [{}, {"improvement": 0.05}], ids=["not more", "less"])
def test_a_verdict_that_died_after_a_transaction_continues(
    improvement: dict[str, float], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every third transaction, from the last one on."""
    settings = exploiting(max_blocks=20, exploiters={"count": 2, "blocks": 4} | improvement)
    league(tmp_path / "fresh", settings, MIDDLING, STRONG).close()

    def run(registry: Registry) -> None:
        nightly(settings, registry=registry, train=strongest(registry))

    def result(registry: Registry) -> tuple[object, ...]:
        return (
            [(row.role, row.exploits) for row in registry.versions.all(LEAGUE)],
            [row.outcome for row in registry.verdicts.all(LEAGUE) if row.candidate == 2],
            [(event.version, event.previous) for event in registry.aliases.history(LEAGUE)],
        )

    monkeypatch.setattr("evaluation.gating.nightly.RATING_BLOCKS", 1)
    runs = after_crashes(tmp_path / "fresh", run, 3, monkeypatch)
    expected = result(next(runs)[1])
    assert [exploits for _, exploits in expected[0][2:]] == ["tictactoe@2"] * 2 + ["tictactoe@1"] * 2
    for crash_at, registry in runs:
        assert result(registry) == expected, f"after transaction {crash_at}"
