from pathlib import Path

from league.stack import VERIFIED, installed


def test_the_verified_stack_equals_the_constraints() -> None:
    lines = Path("constraints.txt").read_text().splitlines()
    pins = dict(line.lower().split("==") for line in lines if "==" in line)
    assert {package: pins.get(package) for package in VERIFIED} == VERIFIED


def test_the_tests_run_on_the_verified_stack() -> None:
    assert {name: version.partition("+")[0] for name, version in installed().items()} == VERIFIED
