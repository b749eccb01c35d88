import subprocess
import sys

from league.registry.processes import has_ended, host_name, is_local, this_process

PROGRAM = "from league.registry.processes import this_process; print(this_process(), flush=True); input()"


def test_a_process_ends() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as child:
        assert child.stdout is not None
        identity = child.stdout.readline().strip()
        assert is_local(identity)
        assert not has_ended(identity)
        child.communicate("\n")
    assert has_ended(identity)
    assert not has_ended(this_process())


def test_another_process_with_the_same_id() -> None:
    machine, pid, start = this_process().split(":")
    assert has_ended(f"{machine}:{pid}:{int(start) - 1}")


def test_nothing_is_known_of_processes_on_other_machines() -> None:
    _, pid, start = this_process().split(":")
    elsewhere = f"trainer-7/another-start/1:{pid}:{int(start) - 1}"
    assert not is_local(elsewhere)
    assert not has_ended(elsewhere)
    assert host_name(elsewhere) == "trainer-7"
