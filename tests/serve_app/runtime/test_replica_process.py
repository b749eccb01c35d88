import subprocess
import sys

from serve_app.runtime.replica_process import has_ended, this_process

DESCRIBE = "from serve_app.runtime.replica_process import this_process; print(this_process().description['process'])"


def test_a_process_that_runs_has_not_ended() -> None:
    assert not has_ended(this_process().description)


def test_a_process_of_this_machine_has_ended() -> None:
    described = subprocess.run([sys.executable, "-c", DESCRIBE], stdout=subprocess.PIPE, text=True, check=True).stdout
    assert has_ended({"process": described.strip()})


def test_nothing_is_known_of_a_replica_that_does_not_describe_its_process() -> None:
    """Another release may describe it by other keys."""
    assert not has_ended({"machine": "another/1", "pid": "1", "start": "1"})
    assert not has_ended({})
