from pathlib import Path

import pytest

from league.errors import AlreadyRunning, ConfigError, NotFound
from league.registry.storage.manifest import EXPLOITER
from league.settings import Storage
from tests.support.leagues.training_leagues import tictactoe
from training.runs.run_directory import CHECKPOINTS, RunDirectory, against


@pytest.fixture
def storage(tmp_path: Path) -> Storage:
    return Storage.at(tmp_path)


def test_the_latest_run_is_resumed(storage: Storage) -> None:
    RunDirectory.begin(storage, tictactoe(), None, None)
    newest = RunDirectory.begin(storage, tictactoe(), 3, "abc")
    latest_path = newest.path.rename(newest.path.with_name("9" + newest.id))
    run = RunDirectory.resume(storage, tictactoe())
    assert run.path == latest_path
    assert (run.record.parent, run.record.git_commit, run.record.config) == (3, "abc", tictactoe())


def test_resuming_requires_an_incomplete_run(storage: Storage) -> None:
    with pytest.raises(NotFound, match="no training run"):
        RunDirectory.resume(storage, tictactoe())
    RunDirectory.begin(storage, tictactoe(), None, None).complete()
    with pytest.raises(NotFound, match="complete"):
        RunDirectory.resume(storage, tictactoe())


def test_only_the_budget_may_change(storage: Storage) -> None:
    RunDirectory.begin(storage, tictactoe(), None, None)
    RunDirectory.resume(storage, tictactoe(steps=5, minutes=1, checkpoint_every=2, checkpoint_minutes=3, runners=3))
    with pytest.raises(ConfigError, match=r"training\.lr has changed"):
        RunDirectory.resume(storage, tictactoe(lr=0.5))


def test_a_complete_run_continues_with_a_larger_budget(storage: Storage) -> None:
    RunDirectory.begin(storage, tictactoe(steps=10, minutes=5), None, None).complete()
    for budget in ({"steps": 10, "minutes": 5}, {"steps": 9, "minutes": 4}):
        with pytest.raises(NotFound, match="unless --steps or --minutes is larger"):
            RunDirectory.resume(storage, tictactoe(**budget))
    assert not RunDirectory.resume(storage, tictactoe(steps=11, minutes=5)).record.complete
    RunDirectory.resume(storage, tictactoe(steps=11, minutes=5)).complete()
    assert RunDirectory.resume(storage, tictactoe(minutes=5)).record.config.training.max_steps is None
    RunDirectory.resume(storage, tictactoe(minutes=5)).complete()
    with pytest.raises(NotFound, match="unless --steps or --minutes is larger"):
        RunDirectory.resume(storage, tictactoe(minutes=5))
    assert RunDirectory.resume(storage, tictactoe(steps=11)).record.config.training.minutes is None


def test_opponents_remain_pinned_in_a_resumed_run(storage: Storage) -> None:
    """The alias may have moved in the meantime."""
    written = tictactoe(opponents=[{"ref": "@champion", "share": 0.5}])
    run = RunDirectory.begin(storage, written, None, None, {"@champion": "tictactoe@3"})
    assert run.record.config.training.opponents.fixed[0].ref == "tictactoe@3"
    assert RunDirectory.resume(storage, written).record.config == run.record.config
    for other in ({"ref": "@latest", "share": 0.5}, {"ref": "@champion", "share": 0.25}):
        with pytest.raises(ConfigError, match=r"training\.opponents has changed"):
            RunDirectory.resume(storage, tictactoe(opponents=[other]))


def test_runs_are_resumed_by_role(storage: Storage) -> None:
    """An exploiter has its target as the opponent in all episodes, also where the league's file names others."""
    written = tictactoe(opponents=[{"ref": "script:random", "share": 0.5}])
    main = RunDirectory.begin(storage, written, None, None)
    with pytest.raises(NotFound, match="no training run with the role exploiter"):
        RunDirectory.resume(storage, written, EXPLOITER)
    exploiter = RunDirectory.begin(storage, against(written, "tictactoe@3"), None, None, exploits="tictactoe@3")
    assert RunDirectory.resume(storage, written).id == main.id
    resumed = RunDirectory.resume(storage, written, EXPLOITER)
    assert (resumed.id, resumed.record) == (exploiter.id, exploiter.record)
    assert [(each.ref, each.share) for each in resumed.record.config.training.opponents.fixed] == [("tictactoe@3", 1)]


def test_one_driver_at_a_time(storage: Storage) -> None:
    run = RunDirectory.begin(storage, tictactoe(), None, None)
    with run.locked():
        other = RunDirectory.resume(storage, tictactoe())
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
