from pathlib import Path

import pytest

from league.errors import AlreadyRunning, ConfigError, NotFound
from league.settings import Storage
from tests.training.leagues import tictactoe
from training.runs import CHECKPOINTS, Run


@pytest.fixture
def storage(tmp_path: Path) -> Storage:
    return Storage.at(tmp_path)


def test_the_newest_run_is_resumed(storage: Storage) -> None:
    Run.begin(storage, tictactoe(), None, None)
    newest = Run.begin(storage, tictactoe(), 3, "abc")
    later = newest.path.rename(newest.path.with_name("9" + newest.id))
    run = Run.resume(storage, tictactoe())
    assert run.path == later
    assert (run.record.parent, run.record.git_commit, run.record.config) == (3, "abc", tictactoe())


def test_nothing_to_resume(storage: Storage) -> None:
    with pytest.raises(NotFound, match="no training run"):
        Run.resume(storage, tictactoe())
    Run.begin(storage, tictactoe(), None, None).complete()
    with pytest.raises(NotFound, match="complete"):
        Run.resume(storage, tictactoe())


def test_only_the_budget_may_change(storage: Storage) -> None:
    Run.begin(storage, tictactoe(), None, None)
    Run.resume(storage, tictactoe(steps=5, minutes=1, checkpoint_every=2, checkpoint_minutes=3, runners=3))
    with pytest.raises(ConfigError, match=r"training\.lr has changed"):
        Run.resume(storage, tictactoe(lr=0.5))


def test_a_complete_run_goes_on_with_a_larger_budget(storage: Storage) -> None:
    Run.begin(storage, tictactoe(steps=10, minutes=5), None, None).complete()
    for budget in ({"steps": 10, "minutes": 5}, {"steps": 9, "minutes": 4}):
        with pytest.raises(NotFound, match="unless --steps or --minutes is larger"):
            Run.resume(storage, tictactoe(**budget))
    assert not Run.resume(storage, tictactoe(steps=11, minutes=5)).record.complete
    Run.resume(storage, tictactoe(steps=11, minutes=5)).complete()
    assert Run.resume(storage, tictactoe(steps=11)).record.config.training.minutes is None


def test_opponents_stay_who_they_were_when_the_run_began(storage: Storage) -> None:
    """Though the alias may have moved since."""
    written = tictactoe(opponents=[{"ref": "@champion", "share": 0.5}])
    begun = Run.begin(storage, written, None, None, {"@champion": "tictactoe@3"})
    assert begun.record.config.training.opponents[0].ref == "tictactoe@3"
    assert Run.resume(storage, written).record.config == begun.record.config
    for other in ({"ref": "@latest", "share": 0.5}, {"ref": "@champion", "share": 0.25}):
        with pytest.raises(ConfigError, match=r"training\.opponents has changed"):
            Run.resume(storage, tictactoe(opponents=[other]))


def test_one_driver_at_a_time(storage: Storage) -> None:
    run = Run.begin(storage, tictactoe(), None, None)
    with run.locked():
        other = Run.resume(storage, tictactoe())
        with pytest.raises(AlreadyRunning, match=run.id), other.locked():
            pass
    with run.locked():
        pass


def test_checkpoints_of_all_lives_by_steps_and_only_whole_ones(storage: Storage) -> None:
    run = Run.begin(storage, tictactoe(), None, None)
    for names in (("9", "100"), ("200.part", "150")):
        life = run.next_life()
        for name in names:
            (life / CHECKPOINTS / name).mkdir(parents=True)
    assert [path.name for path in run.checkpoints()] == ["9", "100", "150"]
    assert [life.name for life in run.lives()] == ["life-1", "life-2"]
    run.forget_checkpoints()
    assert run.checkpoints() == []
    assert run.next_life().name == "life-3"
