import shutil
import threading
from collections.abc import Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace

import pytest
from sqlalchemy import update

from league.config.league import LeagueConfig
from league.config.ppo import PPOConfig
from league.errors import AlreadyRunning, ConfigError, InvalidInput, LeagueError, NotFound, RunCorrupt, UnknownVersion
from league.registry.registry import Registry
from league.registry.storage import rows
from league.registry.storage.manifest import EXPLOITER
from league.registry.storage.rows import RunRow
from league.settings import Storage
from tests.support.leagues import tictactoe as league_of_tictactoe
from tests.support.leagues.training_leagues import tictactoe
from training.algorithms.resources import Resources
from training.runs import run_directory
from training.runs.run_directory import CHECKPOINTS, RunDirectory, pin_opponents, with_pins
from training.runs.run_reporter import RunReporter
from training.sampling.opponents import without_mixtures


@pytest.fixture
def storage(registry: Registry) -> Storage:
    return registry.storage


@pytest.fixture
def elsewhere(registry: Registry, tmp_path: Path) -> Iterator[Registry]:
    """The same registry on another machine."""
    opened = Registry.open(replace(registry.storage, home=tmp_path / "elsewhere"))
    yield opened
    opened.close()


def start(registry: Registry, run: RunDirectory) -> None:
    with suppress(KeyboardInterrupt), RunReporter(registry, run) as reporter:
        reporter.begin(0, 0.0)
        raise KeyboardInterrupt


def change(registry: Registry, run: RunDirectory, **columns: object) -> None:
    with registry.database.write() as session:
        session.execute(update(RunRow).filter_by(id=run.id).values(**columns))


def test_the_latest_run_is_resumed(registry: Registry, storage: Storage) -> None:
    RunDirectory.begin(storage, tictactoe(), None, None)
    newest = RunDirectory.begin(storage, tictactoe(), 3, "abc")
    latest_path = newest.path.rename(newest.path.with_name("9" + newest.id[1:]))
    run = RunDirectory.resume(registry, tictactoe())
    assert run.path == latest_path
    assert (run.record.parent, run.record.git_commit, run.record.config) == (3, "abc", tictactoe())


def test_resuming_requires_an_incomplete_run(registry: Registry, storage: Storage) -> None:
    with pytest.raises(NotFound, match="no training run"):
        RunDirectory.resume(registry, tictactoe())
    RunDirectory.begin(storage, tictactoe(), None, None).complete()
    with pytest.raises(NotFound, match="complete"):
        RunDirectory.resume(registry, tictactoe())


def test_only_the_budget_may_change(registry: Registry, storage: Storage) -> None:
    RunDirectory.begin(storage, tictactoe(), None, None)
    RunDirectory.resume(registry, tictactoe(steps=5, minutes=1, checkpoint_every=2, checkpoint_minutes=3, runners=3))
    with pytest.raises(ConfigError, match=r"training\.lr has changed"):
        RunDirectory.resume(registry, tictactoe(lr=0.5))


AUTO = {"runners": "auto", "num_envs": "auto", "threads": "auto", "gpus": "auto"}
CHOSEN = Resources(runners=3, num_envs=16, threads=2, gpus=1.0)


def test_a_resumed_run_keeps_what_was_chosen_when_it_began(registry: Registry, storage: Storage) -> None:
    """On any machine, so that its versions are those of the uninterrupted run."""
    RunDirectory.begin(storage, tictactoe(**AUTO), None, None).use(CHOSEN)
    resumed = RunDirectory.resume(registry, tictactoe(**AUTO)).record.config
    assert resumed == tictactoe(**CHOSEN.settings)
    resumed = RunDirectory.resume(registry, tictactoe(**AUTO | {"runners": 1, "gpus": 0})).record.config
    assert resumed == tictactoe(**CHOSEN.settings | {"runners": 1, "gpus": 0.0})
    with pytest.raises(ConfigError, match=r"training\.num_envs has changed"):
        RunDirectory.resume(registry, tictactoe(**AUTO | {"num_envs": 8}))


def test_a_run_with_a_name_fits_the_machine_that_continues_it(registry: Registry) -> None:
    RunDirectory.begin(registry.storage, tictactoe(**AUTO), None, None, name="night-1").use(CHOSEN)
    run = RunDirectory.find(registry, tictactoe(**AUTO), "night-1")
    assert run is not None
    assert run.record.config == tictactoe(**AUTO | {"num_envs": 16, "batch_scale": 1}), "what is learned is kept"


def test_a_complete_run_continues_with_a_larger_budget(registry: Registry, storage: Storage) -> None:
    RunDirectory.begin(storage, tictactoe(steps=10, minutes=5), None, None).complete()
    for budget in ({"steps": 10, "minutes": 5}, {"steps": 9, "minutes": 4}):
        with pytest.raises(NotFound, match="unless --steps or --minutes is larger"):
            RunDirectory.resume(registry, tictactoe(**budget))
    assert not RunDirectory.resume(registry, tictactoe(steps=11, minutes=5)).record.complete
    RunDirectory.resume(registry, tictactoe(steps=11, minutes=5)).complete()
    assert RunDirectory.resume(registry, tictactoe(minutes=5)).record.config.training.max_steps is None
    RunDirectory.resume(registry, tictactoe(minutes=5)).complete()
    with pytest.raises(NotFound, match="unless --steps or --minutes is larger"):
        RunDirectory.resume(registry, tictactoe(minutes=5))
    assert RunDirectory.resume(registry, tictactoe(steps=11)).record.config.training.minutes is None


def test_opponents_remain_pinned_in_a_resumed_run(registry: Registry, storage: Storage) -> None:
    """The alias may have moved in the meantime."""
    written = tictactoe(opponents=[{"ref": "@champion", "share": 0.5}])
    run = RunDirectory.begin(storage, written, None, None, {"@champion": "tictactoe@3"})
    assert run.record.config.training.opponents.fixed[0].ref == "tictactoe@3"
    assert RunDirectory.resume(registry, written).record.config == run.record.config
    for other in ({"ref": "@latest", "share": 0.5}, {"ref": "@champion", "share": 0.25}):
        with pytest.raises(ConfigError, match=r"training\.opponents has changed"):
            RunDirectory.resume(registry, tictactoe(opponents=[other]))


def test_runs_are_resumed_by_role(registry: Registry, storage: Storage) -> None:
    """An exploiter has its target as the opponent in all episodes, also where the league's file names others."""
    written = tictactoe(opponents=[{"ref": "script:random", "share": 0.5}])
    main = RunDirectory.begin(storage, written, None, None)
    with pytest.raises(NotFound, match="no training run with the role exploiter"):
        RunDirectory.resume(registry, written, EXPLOITER)
    exploiter = RunDirectory.begin(storage, written.against("tictactoe@3"), None, None, exploits="tictactoe@3")
    assert RunDirectory.resume(registry, written).id == main.id
    resumed = RunDirectory.resume(registry, written, EXPLOITER)
    assert (resumed.id, resumed.record) == (exploiter.id, exploiter.record)
    assert [(opponent.ref, opponent.share) for opponent in resumed.record.config.training.opponents.fixed] == [
        ("tictactoe@3", 1)
    ]


def test_settings_of_exploiters_concern_the_runs_of_exploiters(registry: Registry, storage: Storage) -> None:
    main = RunDirectory.begin(storage, tictactoe(), None, None)
    RunDirectory.begin(storage, tictactoe().against("tictactoe@3"), None, None, exploits="tictactoe@3")
    changed = tictactoe(exploiter={"gamma": 0.5})
    assert RunDirectory.resume(registry, changed).id == main.id
    with pytest.raises(ConfigError, match=r"training\.gamma has changed"):
        RunDirectory.resume(registry, changed, EXPLOITER)


def test_one_driver_at_a_time(registry: Registry, storage: Storage) -> None:
    run = RunDirectory.begin(storage, tictactoe(), None, None)
    with run.locked():
        other = RunDirectory.resume(registry, tictactoe())
        with pytest.raises(AlreadyRunning, match=run.id), other.locked():
            pass
    with run.locked():
        pass


def test_complete_checkpoints_of_all_attempts_are_sorted_by_steps(storage: Storage) -> None:
    run = RunDirectory.begin(storage, tictactoe(), None, None)
    for names in (("9", "100"), ("200.part", "150")):
        attempt = run.next_attempt()
        for name in names:
            (attempt / CHECKPOINTS / name).mkdir(parents=True)
    assert [path.name for path in run.checkpoints()] == ["9", "100", "150"]
    assert [attempt.name for attempt in run.attempts()] == ["attempt-1", "attempt-2"]
    run.remove_checkpoints()
    assert run.checkpoints() == []
    assert run.next_attempt().name == "attempt-3"


def test_a_run_is_resumed_on_another_machine(registry: Registry, elsewhere: Registry) -> None:
    written = tictactoe(opponents=[{"ref": "@champion", "share": 0.5}])
    run = RunDirectory.begin(registry.storage, written, 3, "abc", {"@champion": "tictactoe@3"})
    with pytest.raises(NotFound, match=r"neither in .*elsewhere.* nor in the registry"):
        RunDirectory.resume(elsewhere, written)
    assert RunDirectory.find(elsewhere, tictactoe(), run.id) is None
    start(registry, run)
    resumed = RunDirectory.resume(elsewhere, written)
    assert (resumed.id, resumed.record) == (run.id, run.record)
    assert resumed.path == elsewhere.storage.home / "runs" / "tictactoe" / run.id
    assert RunDirectory.find(elsewhere, tictactoe(), run.id).record == run.record


@pytest.mark.parametrize("by_name", [False, True])
def test_a_run_is_trained_on_one_machine_at_a_time(
    registry: Registry, elsewhere: Registry, by_name: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_directory, "POLL", 0.01)
    run = RunDirectory.begin(registry.storage, tictactoe(), None, None)
    start(registry, run)
    change(registry, run, reported_state="running", driver="trainer-7/boot/1:10:20")
    is_over = threading.Event()

    def send_heartbeats() -> None:
        while not is_over.wait(0.01):
            registry.runs.record("tictactoe", run.id, None)

    driver = threading.Thread(target=send_heartbeats)
    driver.start()
    try:
        for one in (registry, elsewhere):
            with pytest.raises(AlreadyRunning, match=rf"{run.id} is running on trainer-7"):
                RunDirectory.find(one, tictactoe(), run.id) if by_name else RunDirectory.resume(one, tictactoe())
    finally:
        is_over.set()
        driver.join()


def test_a_run_continues_when_the_machine_that_trained_it_is_silent(
    registry: Registry, elsewhere: Registry, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fall_silent(_: float) -> None:
        monkeypatch.setattr(rows, "HEARTBEAT_TIMEOUT", timedelta(0))

    monkeypatch.setattr(run_directory, "time", SimpleNamespace(sleep=fall_silent))
    run = RunDirectory.begin(registry.storage, tictactoe(), None, None)
    start(registry, run)
    change(registry, run, reported_state="running", driver="trainer-7/boot/1:10:20", heartbeat_at=datetime.now(UTC))
    assert RunDirectory.resume(elsewhere, tictactoe()).id == run.id
    assert timedelta(0) == rows.HEARTBEAT_TIMEOUT
    assert f"{run.id} was running on trainer-7; waiting for up to 60 s" in caplog.text


def test_a_run_that_ended_on_another_machine_is_complete(registry: Registry) -> None:
    """The record on this machine is from before it continued there."""
    run = RunDirectory.begin(registry.storage, tictactoe(steps=10), None, None)
    start(registry, run)
    change(registry, run, reported_state="ended", driver="trainer-7/boot/1:10:20")
    with pytest.raises(NotFound, match="is complete"):
        RunDirectory.resume(registry, tictactoe(steps=10))
    assert RunDirectory.find(registry, tictactoe(), run.id).record.complete
    assert not RunDirectory.resume(registry, tictactoe(steps=11)).record.complete


def test_a_changed_record_is_named(registry: Registry, storage: Storage) -> None:
    run = RunDirectory.begin(storage, tictactoe(), None, None)
    (run.path / "run.json").write_text("{")
    with pytest.raises(RunCorrupt, match=rf"{run.path}/run\.json: file: not valid JSON"):
        RunDirectory.resume(registry, tictactoe())


def test_a_changed_record_in_the_registry_is_named(registry: Registry, storage: Storage) -> None:
    run = RunDirectory.begin(storage, tictactoe(), None, None)
    start(registry, run)
    shutil.rmtree(run.path)
    change(registry, run, record={"config": 5})
    with pytest.raises(RunCorrupt, match=rf"run {run.id} in the registry: \S+: "):
        RunDirectory.resume(registry, tictactoe())


def test_a_run_with_a_name_keeps_its_settings_but_not_its_resources(registry: Registry) -> None:
    """A machine that is too small for a run of a night must not stop all later nights."""
    config = tictactoe(runners=8, gpus=1, lr=0.01, steps=1000)
    RunDirectory.begin(registry.storage, config, None, None, name="night-1")
    run = RunDirectory.find(registry, tictactoe(runners=1, gpus=0, lr=0.5, steps=10), "night-1")
    assert run is not None
    settings = run.record.config.training
    assert (settings.runners, settings.gpus, settings.steps) == (1, 0, 1000)
    assert settings.model_dump()["lr"] == config.training.model_dump()["lr"]


def test_runs_of_nights_and_gates_are_not_resumed_by_hand(storage: Storage, registry: Registry) -> None:
    by_hand = RunDirectory.begin(storage, tictactoe(), None, None)
    RunDirectory.begin(storage, tictactoe(seed=7), None, None, name="99990101-200000-night-1")
    assert RunDirectory.resume(registry, tictactoe()).id == by_hand.id


def with_opponents(*refs: str) -> LeagueConfig:
    return league_of_tictactoe.config().with_training(opponents=[{"ref": ref, "share": 0.3} for ref in refs])


def promote(registry: Registry, number: int) -> None:
    registry.aliases.set("tictactoe", "champion", number, expected=None, actor="me", reason="first")


@pytest.fixture
def two_versions(tmp_path: Path) -> Iterator[Registry]:
    with closing(league_of_tictactoe.registry(tmp_path)) as registry:
        for _ in range(2):
            league_of_tictactoe.publish(registry, league_of_tictactoe.graph())
        yield registry


@pytest.fixture
def mixed_champion(two_versions: Registry) -> Registry:
    """The champion is a mixture, @3, of two versions."""
    promote(two_versions, two_versions.publisher.publish_mixture("tictactoe", {1: 0.25, 2: 0.75}).number)
    return two_versions


def pins_of(registry: Registry, league: LeagueConfig, trials: Sequence[LeagueConfig] = ()) -> dict[str, str]:
    return pin_opponents(league, registry, registry.leagues.get("tictactoe").interface, trials)


def test_references_are_pinned_when_training_starts(two_versions: Registry) -> None:
    promote(two_versions, 1)
    league = with_opponents("@champion", "tictactoe@2", "script:random")
    pins = pins_of(two_versions, league)
    assert pins == {"@champion": "tictactoe@1", "tictactoe@2": "tictactoe@2", "script:random": "script:random"}
    opponents = with_pins(league, pins).training.opponents.fixed
    assert [opponent.ref for opponent in opponents] == ["tictactoe@1", "tictactoe@2", "script:random"]
    assert [opponent.share for opponent in opponents] == [0.3, 0.3, 0.3]


def test_the_magnet_is_pinned_too(two_versions: Registry) -> None:
    promote(two_versions, 1)
    for ref, pinned in (("@champion", {"@champion": "tictactoe@1"}), ("uniform", {})):
        league = league_of_tictactoe.config().with_training(magnet={"ref": ref, "weight": 0.1})
        assert pins_of(two_versions, league) == pinned
        settings = with_pins(league, pinned).training
        assert isinstance(settings, PPOConfig)
        assert settings.magnet is not None
        assert settings.magnet.ref == pinned.get(ref, ref)


def test_a_mixture_is_pinned_as_one_and_played_by_its_members(mixed_champion: Registry) -> None:
    league = with_opponents("@champion", "script:random")
    pins = pins_of(mixed_champion, league)
    assert pins == {"@champion": "tictactoe@3", "script:random": "script:random"}
    fixed = with_pins(league, pins).training.opponents.fixed
    played = without_mixtures(fixed, mixed_champion.storage)
    assert [opponent.ref for opponent in played] == ["tictactoe@1", "tictactoe@2", "script:random"]
    assert [opponent.share for opponent in played] == pytest.approx([0.075, 0.225, 0.3])
    magnet = league_of_tictactoe.config().with_training(magnet={"ref": "@champion", "weight": 0.1})
    with pytest.raises(InvalidInput, match=r"tictactoe@3 is a mixture \(@1 25.0 %, @2 75.0 %\): name one of its memb"):
        pins_of(mixed_champion, magnet)


def test_in_training_a_search_version_plays_without_its_search(two_versions: Registry) -> None:
    two_versions.publisher.publish_search("tictactoe", 1, "puct", 8, 1.0)
    league = with_opponents("@3").with_training(teacher={"ref": "@3", "weight": 1})
    assert pins_of(two_versions, league) == {"@3": "tictactoe@1"}


def test_the_references_of_a_sweeps_trials_are_pinned_too(mixed_champion: Registry) -> None:
    trials = [
        with_opponents("@champion"),
        league_of_tictactoe.config().with_training(teacher={"ref": "@2", "weight": 1}),
    ]
    pins = pins_of(mixed_champion, with_opponents("script:random"), trials)
    assert pins == {"script:random": "script:random", "@champion": "tictactoe@3", "@2": "tictactoe@2"}
    trials += [league_of_tictactoe.config().with_training(teacher={"ref": "@champion", "weight": 1})]
    with pytest.raises(InvalidInput, match=r"tictactoe@3 is a mixture"):
        pins_of(mixed_champion, with_opponents("script:random"), trials)


def test_unknown_opponents_are_rejected(two_versions: Registry) -> None:
    for ref, error in (("@3", UnknownVersion), ("champion", ConfigError), ("script:stockfish", LeagueError)):
        with pytest.raises(error, match=ref.strip("@").removeprefix("script:")):
            pins_of(two_versions, with_opponents(ref))
