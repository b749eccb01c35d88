import subprocess
import sys

import pytest

from league.errors import AlreadyRunning, Conflict, NotFound, UnknownLeague
from league.registry.registry import Registry
from league.settings import Storage
from tests.support.leagues.registries import LEAGUE, registered
from tests.support.waiting import until

SETTINGS = {"gate": {"alpha": 0.01}}


@pytest.fixture
def registry(empty: Registry) -> Registry:
    return registered(empty, versions=3)


def test_a_nightly_run_is_opened_once(registry: Registry) -> None:
    night = registry.nightly_runs.open(LEAGUE, [3, 2], 0.001)
    assert (night.candidates, night.alpha, night.report, night.ended_at) == ((2, 3), 0.001, None, None)
    assert registry.nightly_runs.open(LEAGUE, [1], 0.5) == night
    registry.nightly_runs.close(night.id, {"champion": "tictactoe@2"})
    registry.nightly_runs.close(night.id, {})
    (ended,) = registry.nightly_runs.all(LEAGUE)
    assert ended.report == {"champion": "tictactoe@2"}
    assert ended.ended_at is not None
    assert registry.nightly_runs.open(LEAGUE, [1], 0.5).candidates == (1,)
    assert len(registry.nightly_runs.all(LEAGUE)) == 2


def test_a_nightly_run_needs_an_existing_league(registry: Registry) -> None:
    with pytest.raises(UnknownLeague):
        registry.nightly_runs.open("chess", [1], 0.1)
    with pytest.raises(UnknownLeague):
        registry.nightly_runs.all("chess")


def test_an_open_verdict_can_be_voided(registry: Registry) -> None:
    registry.verdicts.open(LEAGUE, 2, "tictactoe@1", "s", SETTINGS)
    voided = registry.verdicts.void("s", "voided by me: games of a broken machine")
    assert (voided.outcome, voided.alpha) == ("void", 0.01)
    assert voided.evidence == {"note": "voided by me: games of a broken machine"}
    assert voided.closed_at is not None
    assert registry.verdicts.void("s", "again") == voided
    with pytest.raises(Conflict, match="is already 'void'"):
        registry.verdicts.close("s", "promote", {})
    with pytest.raises(Conflict, match="cannot promote"):
        registry.aliases.set(LEAGUE, "champion", 2, expected=None, actor="a", reason="r", verdict="s")
    assert registry.aliases.current(LEAGUE) == {}
    with pytest.raises(NotFound, match="no verdict 't'"):
        registry.verdicts.void("t", "note")


def test_a_voided_verdict_keeps_its_evidence(registry: Registry) -> None:
    registry.verdicts.open(LEAGUE, 2, "tictactoe@1", "s", SETTINGS)
    registry.verdicts.close("s", "reject", {"llr": -3.0, "outcome": "reject"})
    voided = registry.verdicts.void("s", "why")
    assert voided.outcome == "void"
    assert voided.evidence == {"llr": -3.0, "outcome": "reject", "note": "why"}


def test_a_verdict_being_applied_cannot_be_voided(registry: Registry) -> None:
    registry.verdicts.open(LEAGUE, 2, "script:random", "s", SETTINGS)
    registry.aliases.set(LEAGUE, "champion", 2, expected=None, actor="a", reason="r", verdict="s")
    with pytest.raises(Conflict, match="is being applied"):
        registry.verdicts.void("s", "why")
    registry.verdicts.close("s", "promote", {})
    assert registry.verdicts.void("s", "why").outcome == "void"
    assert registry.aliases.current(LEAGUE) == {"champion": 2}


HOLDER = """
import sys
from league.registry.registry import Registry
from league.settings import Storage
from tests.support.waiting import until
from pathlib import Path
storage = Storage(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]))
with Registry.open(storage).exclusive_lock("nightly-chess"):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_one_process_holds_the_lock_until_it_exits(empty: Registry) -> None:
    storage: Storage = empty.storage
    command = [sys.executable, "-c", HOLDER, str(storage.home), storage.database_url, str(storage.artifacts)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        with (
            pytest.raises(AlreadyRunning, match="another process is running nightly-chess"),
            empty.exclusive_lock("nightly-chess"),
        ):
            pass
        with empty.exclusive_lock("nightly-go"):
            pass
        holder.kill()
        holder.wait()
    _take_when_free(empty)
    with (
        empty.exclusive_lock("nightly-chess"),
        pytest.raises(AlreadyRunning),
        Registry.open(storage).exclusive_lock("nightly-chess"),
    ):
        pass


def _take_when_free(registry: Registry) -> None:
    """Acquire the lock; a server notices within moments that the connection of its holder is gone."""

    def acquired() -> bool:
        try:
            with registry.exclusive_lock("nightly-chess"):
                return True
        except AlreadyRunning:
            return False

    until(acquired)
