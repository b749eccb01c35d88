"""Subprocesses that answer requests clean up at their end."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from league.errors import WorkerLost
from league.subprocesses import RequestProcess, Subprocess
from tests.support.waiting import until

MODULE = "tests.support.answering"


def test_a_process_cleans_up_when_it_is_closed_also_during_a_request(tmp_path: Path) -> None:
    process = RequestProcess(MODULE, str(tmp_path), work="answers")
    assert process.request("four")[0] == {"length": 5, "size": 0}
    with ThreadPoolExecutor(1) as thread:
        response = thread.submit(process.request, "wait")
        until((tmp_path / "began").exists)
        process.close()
        with pytest.raises(WorkerLost, match="died"):
            response.result()
    assert (tmp_path / "ended").exists()


def test_a_process_cleans_up_when_its_parent_has_ended(tmp_path: Path) -> None:
    process = Subprocess(MODULE, str(tmp_path), output=True)
    process.stdout.readline()
    process.stdin.close()
    assert process.reap() == 0
    assert (tmp_path / "ended").exists()
