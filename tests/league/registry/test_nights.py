import subprocess
import sys

import pytest

from league.errors import AlreadyRunning, Conflict, NotFound, UnknownLeague
from league.registry.registry import Registry
from league.settings import Storage
from tests.evaluation.waiting import until
from tests.league.registry.examples import LEAGUE, registered

SETTINGS = {"gate": {"alpha": 0.01}}


@pytest.fixture
def registry(empty: Registry) -> Registry:
    return registered(empty, versions=3)


def test_a_night_is_opened_once_whatever_else_is_asked_meanwhile(registry: Registry) -> None:
    night = registry.open_night(LEAGUE, [3, 2], 0.001)
    assert (night.candidates, night.alpha, night.report, night.ended_at) == ((2, 3), 0.001, None, None)
    assert registry.open_night(LEAGUE, [1], 0.5) == night
    registry.close_night(night.id, {"champion": "tictactoe@2"})
    registry.close_night(night.id, {})
    (ended,) = registry.nights(LEAGUE)
    assert ended.report == {"champion": "tictactoe@2"}
    assert ended.ended_at is not None
    assert registry.open_night(LEAGUE, [1], 0.5).candidates == (1,)
    assert len(registry.nights(LEAGUE)) == 2


def test_nights_are_of_a_league(registry: Registry) -> None:
    with pytest.raises(UnknownLeague):
        registry.open_night("chess", [1], 0.1)
    with pytest.raises(UnknownLeague):
        registry.nights("chess")


def test_an_open_verdict_is_voided_and_stays_so(registry: Registry) -> None:
    registry.open_verdict(LEAGUE, 2, "tictactoe@1", "s", SETTINGS)
    voided = registry.void_verdict("s", "voided by me: games of a broken machine")
    assert (voided.outcome, voided.alpha) == ("void", 0.01)
    assert voided.evidence == {"note": "voided by me: games of a broken machine"}
    assert voided.closed_at is not None
    assert registry.void_verdict("s", "again") == voided
    with pytest.raises(Conflict, match="is 'void' already"):
        registry.close_verdict("s", "promote", {})
    with pytest.raises(Conflict, match="promotes nobody"):
        registry.set_alias(LEAGUE, "champion", 2, expected=None, actor="a", reason="r", verdict="s")
    assert registry.aliases(LEAGUE) == {}
    with pytest.raises(NotFound, match="no verdict 't'"):
        registry.void_verdict("t", "note")


def test_a_verdict_that_has_fallen_keeps_its_evidence_when_it_is_voided(registry: Registry) -> None:
    registry.open_verdict(LEAGUE, 2, "tictactoe@1", "s", SETTINGS)
    registry.close_verdict("s", "reject", {"llr": -3.0, "outcome": "reject"})
    voided = registry.void_verdict("s", "why")
    assert voided.outcome == "void"
    assert voided.evidence == {"llr": -3.0, "outcome": "reject", "note": "why"}


def test_a_promotion_under_way_is_not_voided(registry: Registry) -> None:
    registry.open_verdict(LEAGUE, 2, "script:random", "s", SETTINGS)
    registry.set_alias(LEAGUE, "champion", 2, expected=None, actor="a", reason="r", verdict="s")
    with pytest.raises(Conflict, match="just being applied"):
        registry.void_verdict("s", "why")
    registry.close_verdict("s", "promote", {})
    assert registry.void_verdict("s", "why").outcome == "void"
    assert registry.aliases(LEAGUE) == {"champion": 2}


HOLDER = """
import sys
from league.registry.registry import Registry
from league.settings import Storage
from tests.evaluation.waiting import until
from pathlib import Path
storage = Storage(Path(sys.argv[1]), sys.argv[2], sys.argv[3])
with Registry.open(storage).alone("nightly-chess"):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_one_process_at_a_time_until_it_is_gone_however_it_ends(empty: Registry) -> None:
    storage: Storage = empty.storage
    command = [sys.executable, "-c", HOLDER, str(storage.home), storage.database_url, str(storage.artifacts)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(AlreadyRunning, match="at work on nightly-chess"), empty.alone("nightly-chess"):
            pass
        with empty.alone("nightly-go"):
            pass
        holder.kill()
        holder.wait()
    _take_when_free(empty)
    with empty.alone("nightly-chess"), pytest.raises(AlreadyRunning), Registry.open(storage).alone("nightly-chess"):
        pass


def _take_when_free(registry: Registry) -> None:
    """A server notices within moments that the holder's connection is gone."""

    def taken() -> bool:
        try:
            with registry.alone("nightly-chess"):
                return True
        except AlreadyRunning:
            return False

    until(taken)
